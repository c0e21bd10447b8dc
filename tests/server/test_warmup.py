"""After the warm-up nothing is left to compile, whatever clients do."""

import random
from collections.abc import Iterator
from dataclasses import replace

import pytest

from client_sdk.bots import DigAndPlace, RunAndJump
from server.game import Game
from server.session import Session
from server.warmup import warm_up
from shared import bulk, edits, kernel, kernels, messages
from shared.bounds import bounds
from shared.checks import SceneError
from shared.messages import Bye, Command, Hello, Inputs, Resync, encode
from shared.scene import load_scene

pytestmark = pytest.mark.skipif(not kernels.available(), reason="there is nothing to compile without Numba")

HISTORY = bounds(32).history


@pytest.fixture
def cold() -> Iterator[None]:
    """Kernels of which nothing has been compiled yet in this process."""
    kernels.compiled.cache_clear()
    yield
    kernels.compiled.cache_clear()


def compiled() -> dict[str, int]:
    """The functions of the kernels that have been called from Python, and for how many kinds of arguments."""
    functions = vars(kernels.compiled(kernel)) | vars(kernels.compiled(bulk))
    found = {name: len(getattr(function, "signatures", ())) for name, function in functions.items()}
    return {name: n for name, n in found.items() if n}


class Void:
    def send(self, message: bytes) -> None: ...

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None: ...


def play(game: Game, seed: int, ticks: int) -> None:
    """Players that build, run, come, go, fall out and lose track; the policies look at the server's own world."""
    rng = random.Random(seed)
    players: list[tuple[Session, DigAndPlace, RunAndJump]] = []
    now = 0.0
    for number in range(1, ticks):
        at = game.world.tick
        for session, builder, runner in players:
            if session.entity not in game.world:
                continue
            wish = runner(game.world, session.entity)
            row = bytes(part & 0xFF for part in wish)
            game.receive(session, encode(Inputs(at + 1, at, row)), now)
            edit = builder.edit(game.world, session.entity)
            if edit is not None:
                game.receive(session, encode(Command(number, at + 1, at - 2.0, edits.NAME, edits.pack(edit))), now)
        if number % 20 == 1:
            session = game.open(Void(), now)
            game.receive(session, encode(Hello(messages.VERSION, {}, "")), now)
            players.append((session, DigAndPlace(rng), RunAndJump(rng)))
        if number % 70 == 0:
            game.receive(players.pop(rng.randrange(len(players)))[0], encode(Bye(1001, "", -1.0)), now)
        now += 1 / game.scene.tick_rate
        game.tick(now, now)
        asker = players[0][0]
        game.rewind.at(at - 1.5, asker.entity).ray((1.0, 2.0, 3.0), (1.0, 0.0, 0.0), 10.0)
        if number % 90 == 0:
            game.world.place(asker.entity, (5.0, 5.0, -200.0))
            game.receive(asker, encode(Resync()), now)


def test_that_something_is_compiled_is_told_once_and_only_then() -> None:
    numba = pytest.importorskip("numba")
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
    warm_up(replace(pit, terrain={"generator": "boxes", "fill": [full, hole]}))
    with pytest.raises(SceneError, match=r"^spawns = .*no room for a 'player'"):
        warm_up(replace(pit, terrain={"generator": "boxes", "fill": [full]}))


@pytest.mark.parametrize("scene", ["arena", "topdown"])
def test_nothing_is_compiled_while_clients_play(cold: None, scene: str) -> None:
    warm_up(load_scene(scene))
    before = compiled()
    assert {"step", "wake_on", "gather", "unlink"} <= before.keys()
    game = Game(load_scene(scene))
    play(game, 3, 300)
    assert game.counters.fell_out > 0
    assert game.counters.left > 0
    assert game.counters.resyncs > 0
    assert game.world.tick > HISTORY, "it went on for long enough"
    assert compiled() == before
