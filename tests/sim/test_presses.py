"""A short press of a key makes the player jump, at any frame rate and tick rate, and is not kept for later."""

import dataclasses
import random
from collections.abc import Iterator
from itertools import pairwise, product

import pytest

from client_sdk import Client, Loopback
from client_sdk.core import Core
from client_sdk.netsim.links import PRESETS
from server.game import Game
from shared.inputs import JUMP, Input
from shared.messages import Inputs, decode_from_client
from shared.scene import load_scene
from sovereign_netcode.playtest import Link, Match, Player
from tests.lengths import long_but

FLAT = load_scene("flat")


class Sent(Core):
    """A core that records the buttons of all inputs that it sends, by tick."""

    def __init__(self) -> None:
        super().__init__("Ann")
        self.buttons: dict[int, int] = {}
        self.held: list[bytes] | None = None
        """Messages that arrived while they are held back; None: messages are not held back."""

    def receive(self, data: bytes, now: float) -> None:
        if self.held is None:
            super().receive(data, now)
        else:
            self.held.append(data)

    def outgoing(self) -> list[bytes]:
        sent = super().outgoing()
        for message in map(decode_from_client, sent):
            if isinstance(message, Inputs):
                self.buttons |= {message.first + i: buttons for i, buttons in enumerate(message.rows[2::3])}
        if self.buttons and self._worlds.play is not None:  # inputs that stay the same are not sent
            newest = max(self.buttons)
            same = range(newest + 1, self._worlds.play.newest + 1)
            self.buttons |= dict.fromkeys(same, self.buttons[newest])
        return sent

    @property
    def presses(self) -> int:
        """Number of times that the jump button goes down, and up again one tick later."""
        ticks = sorted(self.buttons)
        downs = [tick for tick in ticks if self.buttons[tick] & JUMP and not self.buttons.get(tick - 1, 0) & JUMP]
        assert all(self.buttons.get(tick + 1) == 0 for tick in downs)
        return len(downs)


def frames(client: Client, fps: float, seconds: float) -> Iterator[int]:
    """Runs a game's loop. The test sets the input in each frame after the first 2 s."""
    for frame in range(round(fps * seconds)):
        now = frame / fps
        client.poll(now)
        if now > 2:
            yield frame
        client.update(now)


def launches(speeds: list[float]) -> int:
    """Returns how many times a player goes up."""
    return sum(a <= 0 < b for a, b in pairwise(speeds))


@pytest.mark.parametrize(
    ("fps", "rate", "within"),
    long_but(
        [(15, 32, False), (60, 32, True)],
        product([15, 40, 60, 144, 240], [20, 32, 128], [False, True]),
    ),
)
def test_a_tap_jumps(fps: int, rate: int, within: bool) -> None:
    """The key goes down and up in two frames in a row, or within one frame."""
    client = Loopback(Game(dataclasses.replace(FLAT, tick_rate=rate))).join("Ann")
    taps, speeds = 0, []
    for frame in frames(client, fps, 14):
        tap = frame % round(1.1 * fps) == 0
        taps += tap
        client.set_input(0, 0, jump=tap)
        if within:
            client.set_input(0, 0, jump=False)
        me = client.view(frame / fps).me
        assert me is not None
        speeds.append(me.velocity[2])
    assert taps > 10
    assert taps - 1 <= launches(speeds) <= taps, "the last one may be too late"


def playing(player: Player) -> Sent:
    player.match.run_until(lambda: player.core.state == "playing", 30)
    core = player.core
    assert isinstance(core, Sent)
    return core


def kept(core: Core, rng: random.Random) -> Input:
    return core.input


@pytest.mark.parametrize(
    "path", long_but([PRESETS["typical"]], [Link(), Link(0.02), PRESETS["typical"], PRESETS["wifi"]])
)
def test_a_press_at_any_time_between_two_ticks_is_in_one_input(path: Link) -> None:
    """Ticks are predicted when they are due and the input is set at any time, as with `AsyncClient`."""
    match = Match(FLAT, seed=1)
    core = playing(match.join(kept, path, Sent()))
    rng = random.Random(2)
    match.run(3)
    for _ in range(200):
        match.run(rng.uniform(0.07, 0.2))
        core.set_input(Input(0, 0, JUMP))
        match.run(rng.choice((0, 0, 0.001, 0.003)))
        core.set_input(Input(0, 0, 0))
    match.run(1)
    assert core.presses == 200


def test_a_button_that_is_held_is_in_the_inputs_of_its_ticks_and_of_no_others() -> None:
    match = Match(FLAT, seed=3)
    core = playing(match.join(kept, Link(0.02), Sent()))
    rng = random.Random(4)
    match.run(3)
    expected: dict[int, int] = {}
    for _ in range(100):
        for jump in (JUMP, 0):
            core.set_input(Input(0, 0, jump))
            first = max(core.buttons) + 1
            match.run(rng.uniform(0.05, 0.3))
            expected |= dict.fromkeys(range(first, max(core.buttons) + 1), jump)
    assert {tick: core.buttons[tick] for tick in expected} == expected


def test_a_tap_in_mid_air_is_not_remembered_for_the_landing() -> None:
    client = Loopback(Game(FLAT)).join("Ann")
    speeds: list[float] = []
    taps = 0
    for frame in frames(client, 60, 20):
        me = client.view(frame / 60).me
        assert me is not None
        speeds.append(me.velocity[2])
        ground = len(speeds) > 3 and not any(speeds[-3:])
        start, air = ground and frame % 90 == 0, -3 < me.velocity[2] < -1
        taps += start
        client.set_input(0, 0, jump=start or air)
        client.set_input(0, 0, jump=False)
    assert taps > 5
    assert launches(speeds) == taps


@pytest.mark.parametrize("pause_s", long_but([0.3, 3.0], [0.3, 1.0, 3.0, 7.0]))
def test_a_press_ahead_of_a_pause_is_not_remembered_for_the_time_after_it(pause_s: float) -> None:
    match = Match(FLAT, seed=5)
    player = match.join(kept, Link(0.02), Sent())
    core = playing(player)
    match.run(3)
    last = max(core.buttons)
    player.suspend(pause_s)
    core.set_input(Input(0, 0, JUMP))
    core.set_input(Input(0, 0, 0))
    match.run(pause_s + 2)
    downs = [tick for tick in core.buttons if tick > last and core.buttons[tick]]
    assert downs in ([], [last + 1]), "in the next tick, if it has an input"


def test_a_press_while_the_server_is_silent_is_not_remembered() -> None:
    match = Match(FLAT, seed=6)
    player = match.join(kept, Link(0.02), Sent())
    core = playing(player)
    match.run(3)
    core.held = []
    match.run(6)
    last = max(core.buttons)
    core.set_input(Input(0, 0, JUMP))
    core.set_input(Input(0, 0, 0))
    match.run(1)
    assert max(core.buttons) == last, "the client waits for the server"
    held, core.held = core.held, None
    for data in held:
        core.receive(data, player.local)
    match.run(3)
    assert not any(buttons for tick, buttons in core.buttons.items() if tick > last)


def test_a_press_before_the_join_does_not_count() -> None:
    client = Loopback(Game(FLAT)).join("Ann")
    for frame in range(60 * 5):
        client.poll(frame / 60)
        if frame == 3:
            client.set_input(0, 0, jump=True)
            client.set_input(0, 0, jump=False)
        client.update(frame / 60)
        me = client.view(frame / 60).me
        assert me is None or me.velocity[2] <= 0
    assert client.playing
