"""Short runs of the benchmarks of bytes and of memory, and their promises."""

import itertools
import tracemalloc

import pytest

from scripts.benchmarks import abilities, entities, frame, memory, wire
from tests.lengths import long


@pytest.mark.parametrize(("motion", "most"), [("run-and-jump", 9_500), *long(("wander", 7_500), ("restless", 21_000))])
def test_a_hundred_that_move_are_few_bytes_and_every_tick_of_them_is_exact(motion: str, most: int) -> None:
    found = wire.run(motion, 140 if motion == "wander" else 100, 60, 1)
    assert found["differing"] == 0
    assert found["moving"] > 90
    assert 0 < found["bytes_per_s"] < most


@pytest.mark.parametrize("rounds", [3, *long(5)])
@pytest.mark.slow
def test_nothing_stays_of_clients_entities_and_segments_that_are_gone(rounds: int) -> None:
    tracemalloc.start()
    try:
        after = memory.churn(rounds)
    finally:
        tracemalloc.stop()
    # 20 clients, 100 entities and a segment take 300,000 bytes. At first, tables still grow.
    assert all(b - a < 20_000 for a, b in itertools.pairwise(after[1:])), after


@pytest.mark.slow
def test_a_large_world_in_small_has_all_its_entities_and_clients() -> None:
    found = entities.run(300, 4, 1)
    assert (found["entities"], found["clients"]) == (304, 4)
    assert found["awake"] >= 34


@pytest.mark.parametrize(("rtt_ms", "seconds"), [(150, 3), *long((50, 30), (300, 30))])
def test_a_predicted_dash_shows_in_the_next_tick_without_corrections_and_a_command_waits(
    rtt_ms: float, seconds: float
) -> None:
    ours, theirs = (abilities.run(commands, rtt_ms, 2, seconds, 902) for commands in (False, True))
    assert min(ours["dashes"], theirs["dashes"]) >= 2
    assert ours["frames_p95"] <= 2, "a tick is 1.9 frames"
    assert ours["causes"] == {}
    assert theirs["frames"] >= rtt_ms * 60 / 1000
    assert theirs["causes"].keys() == {"server act"}


def test_a_frame_has_all_others_in_view() -> None:
    found = frame.measured(5, 0.5, 903)
    assert found["others"] == 5
    assert 29 <= found["frames"] <= 31
    assert 0 < found["median_us"] <= found["p99_us"]
