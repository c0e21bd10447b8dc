"""The soak test detects players who are stuck although snapshots arrive."""

from collections.abc import Callable
from random import Random

import pytest

from client_sdk.core import Core
from scripts.soak_test.progress import Progress
from scripts.soak_test.walkers import LOOK_S, Walker, walk
from shared.inputs import Input
from shared.messages import Held, Inputs, decode_from_client
from shared.scene import load_scene
from sovereign_netcode.playtest import Link as Line
from sovereign_netcode.playtest import Match

HZ = 32


def stuck(seconds: float, state: Callable[[float], tuple[int, float] | None], *, walks: bool = True) -> float:
    """Returns the stuck time of a player. `state` gives inputs used and blocks walked by time; None: there is no
    snapshot."""
    progress = Progress(walks=walks)
    for tick in range(round(seconds * HZ)):
        if (told := state(tick / HZ)) is not None:
            progress.see(tick / HZ, *told)
    return progress.stuck_s


@pytest.mark.parametrize("walks", [True, False])
def test_a_player_that_walks_is_not_stuck(walks: bool) -> None:
    assert stuck(60, lambda now: (int(now * HZ), 3 * now), walks=walks) == 0


@pytest.mark.parametrize(("again_s", "expected"), [(0.5, 0.0), (1.9, 0.0), (4.0, 2.0), (10.0, 8.0)])
def test_after_a_stall_there_are_two_seconds_to_move_again(again_s: float, expected: float) -> None:
    stall, stalled_s = 5.0, 7.0

    def state(now: float) -> tuple[int, float] | None:
        if stall <= now < stall + stalled_s:
            return None
        done = min(now, stall) + max(now - stall - stalled_s - again_s, 0.0)
        return int(done * HZ), 3 * done

    assert stuck(40, state) == pytest.approx(expected, abs=0.25)  # a quarter of a second is the time for half a block


def test_a_player_that_should_walk_and_does_not_move_is_stuck() -> None:
    assert stuck(10, lambda now: (int(now * HZ), 0.0)) == pytest.approx(8.0, abs=0.1)
    assert stuck(10, lambda now: (int(now * HZ), 0.0), walks=False) == 0


def test_a_player_that_only_others_move_is_stuck() -> None:
    assert stuck(10, lambda now: (7, 3 * now)) == pytest.approx(8.0, abs=0.1)


def test_a_reconnect_restarts_the_time() -> None:
    progress = Progress(walks=True)
    for tick in range(20 * HZ):
        if tick % (HZ + 1) == 0:
            progress.away()
        progress.see(tick / HZ, 0)
    assert progress.stuck_s == 0


def watched(match: Match, core: Core, seconds: float) -> Walker:
    """Runs a match for `seconds`. Returns a walker that looked at the core every `LOOK_S` seconds."""
    walker = Walker(0, 0)
    for _ in range(round(seconds / LOOK_S)):
        match.run(LOOK_S)
        walker.used = core.stats.inputs_used
        walker.look(core, match.now)
    return walker


class Deaf(Core):
    """A client whose inputs are lost while `sends` is False."""

    sends = True

    def outgoing(self) -> list[bytes]:
        sent = super().outgoing()
        return [data for data in sent if self.sends or not isinstance(decode_from_client(data), Inputs | Held)]


def joined() -> tuple[Match, Deaf]:
    """Plays with one walker for 5 s. Returns the match and its core."""
    match, core = Match(load_scene("flat"), 1), Deaf()

    def policy(core: Core, rng: Random) -> Input:
        walk(core)
        return core.input

    match.join(policy, Line(0.02), core)
    match.run(5)
    return match, core


def test_a_walker_walks_and_its_inputs_count() -> None:
    match, core = joined()
    walker = watched(match, core, 20)
    assert walker.progress.stuck_s == 0
    assert walker.walked > 20
    assert core.stats.inputs_used > 0.95 * (core.stats.inputs_sent - HZ)


@pytest.mark.parametrize("stall_s", [1.0, 3.5, 8.0])
def test_a_walker_is_not_stuck_after_its_server_stood_still(stall_s: float) -> None:
    match, core = joined()
    match._started += round(stall_s * HZ)  # no tick for `seconds`
    assert watched(match, core, stall_s + 20).progress.stuck_s == 0


def test_a_walker_whose_inputs_get_lost_is_stuck_although_snapshots_come() -> None:
    match, core = joined()
    core.sends = False
    snapshots = core.stats.snapshots
    walker = watched(match, core, 20)
    assert core.stats.snapshots - snapshots > 18 * HZ
    assert walker.progress.stuck_s == pytest.approx(17.5, abs=1)
