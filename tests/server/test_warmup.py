"""The warm-up game before the real one, and the notice about compiling."""

from dataclasses import replace

import pytest

from server.rules import Rules, prepared
from server.runtime.warmup import warm_up
from shared import kernels
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.checks import SceneError
from shared.scene import load_scene
from shared.world import World
from sovereign_netcode.examples.dodge import Dodge
from sovereign_netcode.examples.race import Race


def test_compiling_is_announced_once_and_only_if_it_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    numba = pytest.importorskip("numba")
    monkeypatch.setenv(kernels.VARIABLE, kernels.NUMBA)
    one, other = numba.njit(lambda: 1), numba.njit(lambda: 2)
    told: list[str] = []
    with kernels.compiling(lambda: told.append("compiling")):
        assert told == []
        assert (one(), other()) == (1, 2)
        assert told == ["compiling"]
    with kernels.compiling(lambda: told.append("again")):
        assert (one(), other()) == (1, 2)
    assert numba.njit(lambda: 3)() == 3
    assert told == ["compiling"]


def test_a_scene_with_room_for_one_is_enough_and_one_without_is_refused_by_name() -> None:
    pit = replace(load_scene("flat"), size=(1, 1, 1), spawns=((16.5, 16.5, 4.0),))
    full, hole = [0, 0, 0, 32, 32, 32, 1], [16, 16, 4, 17, 17, 6, 0]
    narrow = replace(pit, terrain={"generator": "boxes", "fill": [full, hole]})
    untouched = World(narrow, compiled=False)
    untouched.load_terrain()
    assert warm_up(narrow).state_hash() == untouched.state_hash()
    with pytest.raises(SceneError, match=r"^spawns = .*no room for a 'player'"):
        warm_up(replace(pit, terrain={"generator": "boxes", "fill": [full]}))


class Dies(Behaviour):
    """Moves by its buttons and its aim, and is gone after a second."""

    templates = ("player",)
    presses = field(bits=16)

    def turn(self, me: Body) -> None:
        if me.pressed("dash") and me.aim == (1.0, 0.0, 0.0):
            me.presses += 1
        if me.presses > 10:
            me.remove()


@pytest.mark.parametrize("aim", [False, True])
@pytest.mark.parametrize("behaviours", [(), (Dies,)])
def test_scenes_with_aim_and_behaviours_are_warmed_up(aim: bool, behaviours: tuple[type[Behaviour], ...]) -> None:
    scene = replace(load_scene("flat"), size=(2, 2, 1), spawns=((32.5, 32.5, 8.0), (30.5, 32.5, 8.0)))
    scene = replace(scene, buttons=("jump", "dash"), aim=aim).with_behaviours(behaviours)
    untouched = World(scene)
    untouched.load_terrain()
    assert warm_up(scene).state_hash() == untouched.state_hash()


@pytest.mark.parametrize("rules", [Dodge(), Race()])
def test_the_examples_with_behaviours_are_warmed_up(rules: Rules) -> None:
    scene = prepared(rules, load_scene(rules.scene))
    assert warm_up(scene).tick == 0
