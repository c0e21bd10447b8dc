"""The segments that a client sees: added when near, dropped when far, nearest first."""

import random

from server.replication.interest import around, distance, update
from shared.checks import Cell

EVERYWHERE = lambda segment: True  # noqa: E731
FLAT = lambda segment: segment[2] == 0  # noqa: E731


def cube(centre: Cell, radius: int) -> set[Cell]:
    x, y, z = centre
    span = range(-radius, radius + 1)
    return {(x + i, y + j, z + k) for i in span for j in span for k in span}


def moved(sees: set[Cell], centre: Cell, see: int = 1, keep: int = 2) -> tuple[list[Cell], list[Cell]]:
    """Applies one update to `sees`. Returns the added and the dropped segments."""
    added, dropped = update(sees, around(centre, see, EVERYWHERE), keep)
    sees.difference_update(dropped)
    sees.update(added)
    return added, dropped


def test_distance_is_along_the_longest_axis() -> None:
    assert distance((0, 0, 0), (0, 0, 0)) == 0
    assert distance((0, 0, 0), (-2, 1, 1)) == distance((-2, 1, 1), (0, 0, 0)) == 2
    assert distance((0, 0, 5), (1, 2, -5)) == 10


def test_at_first_all_around_is_seen_the_own_segment_first() -> None:
    near = around((4, 5, 6), 1, EVERYWHERE)
    assert near[0] == (4, 5, 6)
    assert (set(near), len(near)) == (cube((4, 5, 6), 1), 27)
    assert update(set(), near, 2) == (list(near), [])


def test_the_nearest_come_first_and_the_order_is_always_the_same() -> None:
    near = around((0, 0, 0), 3, EVERYWHERE)
    assert [distance(segment, (0, 0, 0)) for segment in near] == [0] + [1] * 26 + [2] * 98 + [3] * 218
    assert list(near) == sorted(near, key=lambda segment: (distance(segment, (0, 0, 0)), segment))


def test_only_what_exists_is_seen_but_for_the_own_segment() -> None:
    near = around((0, 0, -1), 1, FLAT)
    assert near == ((0, 0, -1), *sorted(segment for segment in cube((0, 0, -1), 1) if segment[2] == 0))


def test_a_segment_is_let_go_only_beyond_the_wider_radius() -> None:
    sees: set[Cell] = set()
    moved(sees, (0, 0, 0))
    assert moved(sees, (1, 0, 0)) == ([(2, y, z) for y in (-1, 0, 1) for z in (-1, 0, 1)], [])
    added, dropped = moved(sees, (2, 0, 0))
    assert {segment[0] for segment in added} == {3}
    assert {segment[0] for segment in dropped} == {-1}


def test_going_back_and_forth_over_a_border_changes_nothing() -> None:
    sees: set[Cell] = set()
    moved(sees, (0, 0, 0))
    moved(sees, (1, 0, 0))
    for x in (0, 1, 0, 1, 0):
        assert moved(sees, (x, 0, 0)) == ([], [])


def test_a_jump_away_lets_go_of_everything() -> None:
    sees: set[Cell] = set()
    moved(sees, (0, 0, 0))
    added, dropped = moved(sees, (50, 0, 0))
    assert (set(added), set(dropped)) == (cube((50, 0, 0), 1), cube((0, 0, 0), 1))


def test_on_any_walk_the_near_is_seen_and_nothing_far_is() -> None:
    rng = random.Random(5)
    sees: set[Cell] = set()
    x, y, z = 0, 0, 0
    for _ in range(300):
        reach = rng.choice([1, 1, 1, 4])
        x, y, z = (part + rng.randint(-reach, reach) for part in (x, y, z))
        before = set(sees)
        added, dropped = moved(sees, (x, y, z))
        assert cube((x, y, z), 1) <= sees <= cube((x, y, z), 2)
        assert len(set(added)) == len(added)
        assert not before & set(added)
        assert set(dropped) <= before


def test_the_order_is_by_distance_and_then_by_index() -> None:
    rng = random.Random(7)
    for _ in range(50):
        centre = rng.randint(-9, 9), rng.randint(-9, 9), rng.randint(-9, 9)
        see = rng.randint(0, 3)
        there = {segment for segment in cube(centre, see) if rng.random() < 0.5}
        wanted = sorted(there | {centre}, key=lambda segment: (distance(segment, centre), segment))
        assert around(centre, see, there.__contains__) == tuple(wanted)
