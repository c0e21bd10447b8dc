"""Wrong values for a client: each is refused by name, and nothing has changed."""

import asyncio
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from client_sdk import AsyncClient, Client, Loopback
from client_sdk.core import Core
from client_sdk.netsim.links import Link
from client_sdk.transports.common import ConnectError
from server.game import Game
from shared.inputs import Input
from shared.scene import load_scene
from tests.shared.test_wrong_values import WHOLE

NAN = math.nan
FLAT = load_scene("flat")


class Playing:
    """A client in the same program, which has joined."""

    def __init__(self) -> None:
        self.game = Game(FLAT, compiled=False)
        self.client = Loopback(self.game).join("Ann")
        self.frame = 0
        self.play()
        while not self.client.playing:
            self.play()

    def play(self, frames: int = 1) -> None:
        for _ in range(frames):
            self.frame += 1
            self.client.poll(self.frame / 60)
            self.client.update(self.frame / 60)


@pytest.fixture(scope="module")
def playing() -> Playing:
    return Playing()


Act = Callable[[Client, Any], Any]
CASES: list[tuple[str, str, Act, list[Any]]] = [
    ("set_input x", "x = ", lambda c, bad: c.set_input(bad, 0), [NAN, math.inf, 1e300, "1", None, [1], 1j]),
    ("set_input y", "y = ", lambda c, bad: c.set_input(0, bad), [NAN, -math.inf, "1", None, np.array([1, 2])]),
    ("set_input jump", "jump = ", lambda c, bad: c.set_input(0, 0, jump=bad), ["no", None, 0.5, []]),
    ("input", "input", lambda c, bad: c.core.set_input(bad), [
        None, 5, (1, 0), [1, 0, 0], Input(1.5, 0, 0), Input(0, NAN, 0), Input(0, 0, 256), Input(0, "1", 0),  # type: ignore[arg-type]
    ]),
    ("delay", "ticks = ", lambda c, bad: c.set_input_delay(bad), [*WHOLE, -1, 4]),
    ("edit x", "x = ", lambda c, bad: c.edit(bad, 0, 9, 1), WHOLE),
    ("edit far", "y = ", lambda c, bad: c.edit(0, bad, 9, 1), [1 << 28, -(1 << 28), 10**5000]),
    ("edit kind", "kind = ", lambda c, bad: c.edit(0, 0, 9, bad), [*WHOLE, -1, 256]),
    ("command name", "name = ", lambda c, bad: c.command(bad), [None, 5, "", "n" * 33, b"say", "edit"]),
    ("command data", "say: data = ", lambda c, bad: c.command("say", bad), [object(), {1: 2}, 1j, "x" * 2000, 1 << 70]),
    ("link", "link = ", lambda c, bad: setattr(c, "link", bad), [5, "no such", ["wifi"], True]),
    ("poll", "now = ", lambda c, bad: c.poll(bad), [NAN, math.inf, "1", True]),
    ("update", "now = ", lambda c, bad: c.update(bad), [NAN, math.inf, "1", True]),
    ("view", "now = ", lambda c, bad: c.view(bad), [NAN, math.inf, "1", True]),
]  # fmt: skip


@pytest.mark.parametrize(("said", "act", "wrong"), [case[1:] for case in CASES], ids=[name for name, *_ in CASES])
def test_a_wrong_value_is_named_and_nothing_is_done(playing: Playing, said: str, act: Act, wrong: list[Any]) -> None:
    client = playing.client
    core = client.core
    prediction = core.prediction
    assert prediction is not None

    def state() -> tuple[Any, ...]:
        filed = core._commands._number
        return core.input, core.controls.delay, client.link, prediction.predicted.state_hash(), filed

    for bad in wrong:
        before = state()
        with pytest.raises((ValueError, TypeError), match=f"^{said}"):
            act(client, bad)
        assert state() == before
    playing.play(10)
    assert client.playing
    assert (client.stats.divergences, client.stats.corrections, playing.game.counters.malformed) == (0, 0, 0)


def test_numbers_of_numpy_do_what_pythons_do(playing: Playing) -> None:
    client: Any = playing.client
    client.set_input(np.float32(1), np.int64(0), jump=np.True_)
    assert client.core.input == Input(127, 0, 1)
    parts: list[Any] = [np.int16(5), np.int64(6), np.uint8(1)]
    client.core.set_input(Input(*parts))
    assert client.core.input == Input(5, 6, 1)
    assert [type(part) for part in client.core.input[:3]] == [int] * 3
    client.set_input_delay(np.int64(0))
    client.core.set_input(Input())
    playing.play(10)
    assert client.playing


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"scene": "flat"}, "scene = 'flat': must be a `Scene`"),
        ({"patience_s": -1}, "patience_s = -1: must not be negative"),
        ({"patience_s": NAN}, "patience_s = nan: must be finite"),
        ({"patience_s": "5"}, "patience_s = '5': must be a number"),
        ({"timeout": NAN}, "timeout = nan"),
        ({"timeout": -1}, "timeout = -1"),
        ({"timeout": None}, "timeout = None"),
        ({"tls": True}, r"tls = True: must be an ssl\.SSLContext"),
        ({"link": 5}, "link = 5: must be one of lan"),
    ],
)
def test_a_wrong_argument_of_connect_is_named(given: dict[str, Any], said: str) -> None:
    url = "ws://127.0.0.1:1"
    for connect in (lambda: Client.connect(url, **given), lambda: asyncio.run(AsyncClient.connect(url, **given))):
        with pytest.raises(ValueError, match=f"^{said}"):
            connect()


@pytest.mark.parametrize("url", [None, 5, b"ws://127.0.0.1:1", "ws://\ud800", "ws://127.0.0.1:1/\ud800", ""])
def test_an_invalid_address_is_named(url: Any) -> None:
    for connect in (lambda: Client.connect(url), lambda: asyncio.run(AsyncClient.connect(url))):
        with pytest.raises(ConnectError):
            connect()


@pytest.mark.parametrize("game", [None, FLAT, Game, "game"])
def test_a_loopback_without_a_game_is_refused(game: Any) -> None:
    with pytest.raises(ValueError, match=r"^game = .*: must be a `Game`"):
        Loopback(game)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"delay_s": NAN}, "delay_s"), ({"delay_s": -1}, "delay_s"), ({"jitter_s": "1"}, "jitter_s"),
        ({"loss": 2}, "loss"), ({"loss": -0.1}, "loss"), ({"rate": 0}, "rate"), ({"rate": NAN}, "rate"),
    ],
)  # fmt: skip
def test_a_path_that_cannot_be_is_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=f"^{said} = "):
        Link(**given)
    assert Link(rate=math.inf) == Link()


def test_a_patience_without_end_is_one() -> None:
    assert Core(patience_s=math.inf).state == "joining"
