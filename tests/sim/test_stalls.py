"""Play after either clock stood still, at any tick rate: inputs are used again within two seconds."""

import dataclasses
from itertools import product

import pytest

from client_sdk.events import Corrected, Diverged, Resynchronised
from client_sdk.input_loop import AHEAD, BEHIND, PATH
from client_sdk.netsim.links import PRESETS
from server.players.input_queue import InputQueue
from shared.bounds import UNCONFIRMED_S
from shared.inputs import Input
from shared.scene import load_scene
from sovereign_netcode.playtest import Link, Match, Player, wander
from tests.lengths import long, long_but

FLAT = load_scene("flat")
NEAR = Link(0.02)
RATES = (1, 20, 32, 60, 128, 240)


def at(rate: int, path: Link = NEAR, seed: int = 1) -> tuple[Match, Player]:
    """Returns a match at a tick rate, and its one player, who has wandered for 10 s."""
    match = Match(dataclasses.replace(FLAT, tick_rate=rate), seed)
    player = match.join(wander, path)
    match.run_until(lambda: player.core.state == "playing", 30)
    match.run(10)
    player.events.clear()
    return match, player


def queue(match: Match, player: Player) -> InputQueue:
    return match.game.players[player.core.entity].inputs


def used_share(match: Match, player: Player, seconds: float) -> float:
    """Runs for `seconds`. Returns the share of ticks in which the player's own input was used."""
    inputs = queue(match, player)
    before, tick = inputs.used, match.game.world.tick
    match.run(seconds)
    return (inputs.used - before) / (match.game.world.tick - tick)


def causes(player: Player) -> set[str]:
    assert not [event for event in player.events if isinstance(event, Diverged)]
    assert {event.cause for event in player.events if isinstance(event, Corrected)} <= {"late input"}
    return {event.cause for event in player.events if isinstance(event, Resynchronised)}


def stop_server(match: Match, seconds: float) -> None:
    """Runs no tick for `seconds`. Then the schedule goes on with the next tick, and the missed ones are dropped."""
    match._started += round(seconds * match.game.scene.tick_rate)
    match.run(seconds)


def stop_clock(match: Match, player: Player, seconds: float) -> None:
    """Suspends the client's computer together with its monotonic clock."""
    player.suspend(seconds)
    match.run(seconds - 0.001)
    player.clock_start -= seconds
    match.run(0.001)


@pytest.mark.parametrize(("rate", "stall_s"), long_but([(1, 10.0), (32, 1.0)], product(RATES, (0.5, 1.0, 3.5, 10.0))))
def test_every_tick_has_its_input_again_after_the_server_stood_still(rate: int, stall_s: float) -> None:
    match, player = at(rate)
    stop_server(match, stall_s)
    match.run(2)
    assert used_share(match, player, 5) >= 0.98
    assert causes(player) <= {BEHIND, PATH}
    if stall_s >= 1 and rate >= 20:
        assert BEHIND in causes(player)
    assert queue(match, player).refused == 0


@pytest.mark.parametrize(("rate", "asleep_s"), long_but([(1, 8.0), (32, 1.0)], product(RATES, (0.5, 1.0, 3.0, 8.0))))
def test_every_tick_has_its_input_again_after_the_clients_clock_stood_still(rate: int, asleep_s: float) -> None:
    match, player = at(rate)
    stop_clock(match, player, asleep_s)
    match.run(2)
    assert used_share(match, player, 5) >= 0.98
    assert causes(player) <= {AHEAD}
    if asleep_s >= 1 and rate >= 20:
        assert causes(player) == {AHEAD}


@pytest.mark.parametrize(("rate", "leap_s"), long_but([(1, 8.0), (32, 3.0)], product(RATES, (0.5, 3.0, 8.0))))
def test_every_tick_has_its_input_again_after_the_clients_clock_leapt(rate: int, leap_s: float) -> None:
    match, player = at(rate)
    player.clock_start += leap_s
    match.run(2)
    assert used_share(match, player, 5) >= 0.98
    causes(player)


@pytest.mark.parametrize(("seed", "step_s"), long_but([(2, -4.0)], product(range(2, 5), (-4.0, -1.0, 1.0, 4.0))))
def test_a_step_on_a_bad_line_ends_in_no_more_late_inputs_than_before(seed: int, step_s: float) -> None:
    match, player = at(32, PRESETS["far"], seed)
    match.run(30)
    before = used_share(match, player, 30)
    if step_s < 0:
        stop_server(match, -step_s)
    else:
        stop_clock(match, player, step_s)
    match.run(2)
    assert used_share(match, player, 30) >= before - 0.05
    causes(player)


def test_stop_after_stop() -> None:
    match, player = at(32)
    for i in range(12):
        (stop_server if i % 2 else lambda m, s: stop_clock(m, player, s))(match, 0.3 + 0.4 * i)
        match.run(2)
        assert used_share(match, player, 2) == 1.0


def test_after_a_stop_the_present_input_counts() -> None:
    """Inputs that were sent ahead while the server stood still are withdrawn, so they are not used later."""
    match = Match(FLAT, 1)
    player = match.join(lambda core, rng: core.input, NEAR)
    match.run(10)
    player.core.set_input(Input(127, 0, 0))
    stop_server(match, 3.0)
    player.core.set_input(Input(0, 0, 0))
    match.run(1)
    standing = match.game.world.position(player.core.entity)
    match.run(3)
    assert match.game.world.position(player.core.entity) == standing


def test_an_input_is_a_duplicate_only_of_one_that_was_accepted() -> None:
    from tests.server.test_session import EAST, NORTH, filed, inputs

    queue = filed(500, EAST, EAST, tick=10)
    assert queue.refused == 2
    queue.file(inputs(12, NORTH, NORTH), 10, 1.0)
    assert (queue.refused, queue.newest) == (2, 13)
    assert [queue.take(tick) for tick in (11, 12, 13)] == [Input(), NORTH, NORTH]


@pytest.mark.parametrize(
    ("rate", "fps"),
    [
        (1, 60), (32, 1.9),
        *long((128, 7), (1, 1), (5, 1), (20, 1.3), (32, 1), (32, 1000), (60, 1.5), (240, 1), (240, 14), (240, 1000)),
    ],
)  # fmt: skip
def test_any_frame_rate_plays(rate: int, fps: float) -> None:
    match = Match(dataclasses.replace(FLAT, tick_rate=rate), 3)
    player = match.join(wander, NEAR)
    player.frame_s = 1 / fps
    match.run_until(lambda: player.core.state == "playing", 60)
    match.run(8 if rate > 1 else 25)
    assert used_share(match, player, 10) >= 0.98


@pytest.mark.parametrize(
    ("rate", "rtt_s", "fps"),
    [
        (32, 1.0, 1),
        *long((128, 1.0, 0), (240, 0.42, 0), (240, 1.0, 60), (128, 0.5, 0), (32, 1.0, 0), (20, 1.0, 0)),
    ],
)
def test_a_long_link_plays_at_any_rate(rate: int, rtt_s: float, fps: float) -> None:
    match = Match(dataclasses.replace(FLAT, tick_rate=rate), 3)
    player = match.join(wander, Link(rtt_s / 2))
    player.frame_s = 1 / fps if fps else 0.0
    match.run_until(lambda: player.core.state == "playing", 60)
    match.run(15)
    assert used_share(match, player, 10) >= 0.98


def test_a_program_that_becomes_slow_and_fast_again_goes_on() -> None:
    match, player = at(32)
    for fps in (2, 0, 1, 60, 5, 0):
        player.frame_s = 1 / fps if fps else 0.0
        match.at(match.now, player._update, key=player)
        match.run(8)
        assert used_share(match, player, 4) >= 0.98, fps
    assert player.core.stats.lead_s < 0.2


def test_a_line_that_is_silent_for_long_goes_on_where_it_is() -> None:
    match, player = at(32)
    held, receive = [], player.core.receive
    player.core.receive = lambda data, now: held.append(data)  # type: ignore[method-assign]
    match.run(UNCONFIRMED_S + 2)
    player.core.receive = receive  # type: ignore[method-assign]
    for data in held:
        player.core.receive(data, player.local)
    match.run(2)
    assert used_share(match, player, 5) == 1.0
