"""Spawning: players appear at a spawn point, or beside it in a crowd, at little cost."""

import contextlib
import random
from typing import Any

import numpy as np
import pytest

from server.game import spawning
from server.game.spawning import OFFSETS, Spawns
from shared.free_places import box_at, taken
from shared.places import APART
from shared.world import OverlapError, World
from tests.worlds import build, floor


def plain() -> World:
    return build([floor()], player="person", spawns=((0.0, 0.0, 0.0), (8.0, 0.0, 0.0)))


def test_spawns_are_used_in_turn_and_a_crowd_stands_apart() -> None:
    world = plain()
    spawns = Spawns(world)
    places = {world.position(entity) for entity in (spawns.spawn() for _ in range(20)) if entity is not None}
    assert {(0.0, 0.0, 0.0), (8.0, 0.0, 0.0)} <= places
    assert len(places) == 20


def test_a_join_into_a_crowd_tries_few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    world, failed = plain(), 0
    spawns = Spawns(world)

    def counted(*arguments: Any) -> bool:
        nonlocal failed
        occupied = taken(*arguments)
        failed += occupied
        return occupied

    monkeypatch.setattr(spawning, "taken", counted)
    assert None not in [spawns.spawn() for _ in range(300)]
    assert 0 < failed <= 300 * 2, "no more than the spawn points themselves"


def test_a_place_is_found_above_a_crowd_that_is_somewhere_below() -> None:
    """An entity is next to every place, but not in the way. Such places are tried at last."""
    world = build([floor()], player="person", spawns=((0.0, 0.0, 12.0),))
    world.spawn("slab", (-2.0, -2.0, 12.0))
    for i, j in OFFSETS[:168]:
        world.spawn("person", (2.0 * i, 2.0 * j, 0.0))
    entity = Spawns(world).spawn()
    assert entity is not None
    assert world.position(entity)[2] == 12.0


def test_there_is_no_room_where_everything_is_solid() -> None:
    world = build([[-32, -32, -32, 32, 32, 32, 1]], player="person", spawns=((0.0, 0.0, 0.0),))
    assert Spawns(world).spawn() is None


def test_where_a_block_is_nothing_is_tried_and_a_gap_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[list[int]] = []
    world = build([floor(), [-32, -32, 1, 32, 32, 2, 1]], player="person", spawns=((0.0, 0.0, 0.0),))
    stray, spawns = world.spawn("person", (0.0, 0.0, 8.0)), Spawns(world)

    def counted(world: World, row: int, kind: int, box: list[int]) -> bool:
        tried.append(box)
        return taken(world, row, kind, box)

    monkeypatch.setattr(spawning, "taken", counted)
    assert spawns.spawn() is None
    assert tried == [box_at(world, world.scene.index_of["person"], (0, 0, 0))]
    assert not spawns.put_back(stray)
    assert spawns.spawn() is None, "it is known for this tick"
    assert len(tried) == 1
    world.fill((-9, 9, 1), (-7, 11, 2), 0)  # at the height of the head
    world.step()
    entity = spawns.spawn()
    assert entity is not None
    assert world.position(entity) == (-8.0, 10.0, 0.0)
    assert len(tried) == 3


def test_places_near_an_entity_are_those_that_round_to_it_at_any_height() -> None:
    """The table of all places says the same as one comparison per place and entity."""
    rng = random.Random(3)
    world = build([floor()], player="person", spawns=((0.0, 0.0, 0.0),))
    where = []
    for _ in range(60):
        at = rng.uniform(-30, 30), rng.uniform(-30, 30), 8.0 * rng.randint(0, 3)
        with contextlib.suppress(OverlapError):
            where.append(world.position(world.spawn("person", at)))
    world.remove(world.spawn("person", (3.0, 3.0, 28.0)))  # its row is free, and not near anything
    assert len(where) > 20
    for x, y in ((0.0, 0.0), (1.5, -0.75), (20.0, -31.0)):
        near = {(np.rint((ex - x) / APART), np.rint((ey - y) / APART)) for ex, ey, _ in where}
        assert list(Spawns(world)._occupied(x, y)) == [offset in near for offset in OFFSETS]


def test_a_spawn_point_below_the_world_is_the_only_place_there() -> None:
    world = build([floor()], player="person", spawns=((0.0, 0.0, -99.0),))
    first, second = Spawns(world).spawn(), Spawns(world).spawn()
    assert first is not None
    assert world.position(first) == (0.0, 0.0, -99.0)
    assert second is None
