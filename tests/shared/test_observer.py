"""The observer of a world: it is notified of each change once, and of no change that is part of another."""

from collections.abc import Mapping

import pytest

from shared.checks import Cell, SceneError
from shared.inputs import Input, make_input
from shared.layout import Int64s
from shared.world import OverlapError, World
from shared.world_state import WorldState
from tests.worlds import floor, scene


class Log:
    """An observer that keeps the calls in order."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    def touching(self, low: Cell, high: Cell) -> None:
        self.calls.append(("touching", low, high))

    def filled(self, low: Cell, high: Cell, kind: int, push: bool) -> None:
        self.calls.append(("filled", low, high, kind, push))

    def loaded(self, world: WorldState, segment: Cell) -> None:
        self.calls.append(("loaded", segment))

    def unloaded(self, segment: Cell) -> None:
        self.calls.append(("unloaded", segment))

    def wrote_blocks(self, segment: Cell, offsets: list[int], kinds: list[int]) -> None:
        self.calls.append(("wrote_blocks", segment, offsets, kinds))

    def put(self, states: Int64s) -> None:
        self.calls.append(("put", *states[:, 0].tolist()))

    def removed(self, entity: int) -> None:
        self.calls.append(("removed", entity))

    def rebased(self, tick: int) -> None:
        self.calls.append(("rebased", tick))

    def restoring(self) -> None:
        self.calls.append(("restoring",))

    def stepped(self, world: WorldState, inputs: Mapping[int, Input]) -> None:
        self.calls.append(("stepped", world.tick, *inputs))

    def taken(self) -> list[tuple[object, ...]]:
        calls, self.calls = self.calls, []
        return calls


@pytest.fixture(params=[False, True], ids=["plain", "compiled"])
def watched(request: pytest.FixtureRequest) -> tuple[World, Log]:
    """A world with a floor and two boxes at (0, 0, 0) and (4, 0, 0), and its observer."""
    world, log = World(scene([floor(0)]), compiled=request.param), Log()
    world.load_terrain()
    for x in (0, 4):
        world.spawn("box", (x, 0, 0))
    world.observer = log
    return world, log


def test_each_change_is_reported_once(watched: tuple[World, Log]) -> None:
    world, log = watched
    assert world.spawn_many("box", [(8, 0, 0), (12, 0, 0)]) == range(3, 5)
    world.set_velocity(2, (1, 0, 0))
    world.place(2, (4, 4, 0))
    world.put([world.state(1)])
    world.remove(3)
    assert log.taken() == [("put", 3, 4), ("put", 2), ("put", 2), ("put", 1), ("removed", 3)]
    segment = next(iter(world.blocks))
    world.write_blocks(segment, [5], [9])
    world.load_segment(segment, world.blocks.segment(segment))
    assert log.taken() == [
        ("touching", segment, segment), ("wrote_blocks", segment, [5], [9]), ("touching", segment, segment),
        ("loaded", segment),
    ]  # fmt: skip
    world.rebase(7)
    world.step({1: make_input(1, 0)})
    world.restore(world.copy())
    assert log.taken() == [("rebased", 7), ("stepped", 8, 1), ("restoring",)]


def test_what_a_block_pushes_is_part_of_its_change(watched: tuple[World, Log]) -> None:
    world, log = watched
    before = world.state(1)
    assert world.set_block(0, 0, 0, 1, push=True)
    assert world.state(1) != before
    touching, filled = log.taken()
    assert touching[0] == "touching"
    assert filled == ("filled", (0, 0, 0), (1, 1, 1), 1, True)


def test_a_refused_block_is_reported_and_a_refused_spawn_is_not(watched: tuple[World, Log]) -> None:
    world, log = watched
    with pytest.raises(OverlapError):
        world.set_block(4, 0, 0, 1)
    assert [call[0] for call in log.taken()] == ["touching", "filled"]
    with pytest.raises(OverlapError):
        world.spawn_many("box", [(8, 0, 0), (8, 0, 0)])
    with pytest.raises(SceneError):
        world.put([(0,) * 12])
    assert log.taken() == []


def test_a_copy_has_no_observer(watched: tuple[World, Log]) -> None:
    world, log = watched
    world.copy().step()
    assert log.taken() == []
