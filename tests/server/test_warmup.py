"""The warm-up game before the real one, and the notice about compiling."""

from dataclasses import replace

import pytest

from server.runtime.warmup import warm_up
from shared import kernels
from shared.checks import SceneError
from shared.scene import load_scene
from shared.world import World


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
