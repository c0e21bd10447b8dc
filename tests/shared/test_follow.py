"""An entity that goes on as before is not sent. A world that receives only turns equals the stepped one bit by bit."""

import random
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shared import kernels
from shared.checks import Cell, SceneError, Vec
from shared.inputs import NEUTRAL, Input
from shared.layout import (
    BUTTONS,
    CELL,
    CHANGED,
    COLUMNS,
    EDGE_HIGH,
    EVENT_BITS,
    FALL,
    FLAGS,
    GO_X,
    ID,
    LAUNCH,
    LENGTHS,
    LO_X,
    MOVE_X,
    N_CHANGED,
    NEW_BUTTONS,
    NEW_MOVE,
    SIZE_X,
    STOP_X,
    STOP_Z,
    TEMPLATE,
    TEMPLATE_COLUMNS,
    TOLD,
    VX,
    WHOLE,
    Int64s,
    X,
)
from shared.scene import Scene, Template, load_scene
from shared.snapshot import TickEncoder, encode_rows
from shared.units import BLOCK, SEGMENT
from shared.world import OverlapError, World
from tests.lengths import long_but
from tests.mirrored import Mirrored
from tests.packed_turns import pack_turns, stop_of
from tests.worlds import EAST, JUMP, WEST, build, floor, scene, steps

SIDE = SEGMENT * BLOCK


def crowd(made: Scene, n: int, rng: random.Random, compiled: bool) -> World:
    world = World(made, compiled=compiled)
    world.load_terrain()
    x, y, z = made.spawns[0]
    while len(world) < n:
        try:
            world.spawn(rng.choice(made.templates).name, (x + rng.uniform(-14, 14), y + rng.uniform(-14, 14), z + 1))
        except OverlapError:
            continue
    return world


@pytest.mark.parametrize(
    ("name", "rate", "integrator"),
    long_but(
        [("hills", 20, "mean"), ("arena", 32, "semi"), ("topdown", 32, "mean")],
        product(["hills", "arena", "topdown"], [20, 32], ["mean", "semi"]),
    ),
)
def test_a_crowd_that_is_sent_equals_the_crowd(name: str, rate: int, integrator: str, compiled: bool) -> None:
    """Entities meet walls, steps and each other; blocks come and go; entities are thrown and placed. Every bit agrees
    in every tick."""
    rng = random.Random(f"{name} {rate}")
    table: dict[str, Any] = load_scene(name).to_table() | {"tick_rate": rate, "integrator": integrator}
    mirrored = Mirrored(crowd(Scene.from_table(table), 30, rng, compiled))
    world = mirrored.world
    for _ in range(300 if compiled else 60):
        wishes = {
            entity: Input(rng.randint(-89, 89), rng.randint(-89, 89), rng.randint(0, 1))
            for entity in range(1, 31)
            if rng.random() < 0.05
        }
        entity, (x, y, z) = rng.randint(1, 30), world.position(rng.randint(1, 30))
        try:
            for fallen in world.fell:
                world.place(fallen, world.scene.spawns[0], push=True)
            match rng.randrange(12):
                case 0:
                    world.set_velocity(entity, (rng.uniform(-9, 9), 0, rng.uniform(-9, 9)))
                case 1:
                    world.place(entity, (x + rng.uniform(-3, 3), y, z + 2))
                case 2 | 3:
                    world.set_block(int(x // 1), int(y // 1), int(z // 1) - 1, 0)
                case 4 | 5:
                    world.set_block(int(x // 1) + 1, int(y // 1), int(z // 1), 1)
        except SceneError:
            pass
        world.step(wishes)
        mirrored.send()
        mirrored.check()
    assert 50 < mirrored.sent_turns < mirrored.turns * 0.6


@pytest.mark.parametrize("pause", [2, 7, 64])
def test_several_ticks_in_which_nothing_happens_are_as_good_as_one(pause: int, compiled: bool) -> None:
    mirrored = Mirrored(build(gravity=1.0, compiled=compiled))
    for i in range(3):
        mirrored.world.spawn("stone", (3 * i, 0, 25))
        mirrored.world.set_velocity(i + 1, (i / 8, -1 / 8, i))
    mirrored.world.step()
    mirrored.send()
    steps(mirrored.world, pause)
    mirrored.send()
    assert mirrored.sent_turns == 3, "only that they exist"
    mirrored.check()


def events(world: World, entity: int) -> int:
    """Returns the events of an entity in the latest step."""
    row: Int64s = world.rows([entity])[0]
    return int(row[CHANGED]) & (1 << EVENT_BITS) - 1 if row[CHANGED] >> EVENT_BITS == world.tick else 0


def test_each_event_of_an_entity_is_sent_once(compiled: bool) -> None:
    """The entity walks against a wall, jumps over it and falls off the far edge."""
    world = build([floor(0, 8), [3, -9, 0, 4, 9, 1, 1]], compiled=compiled)
    me = world.spawn("box", (0, 0, 0))
    world.step()
    assert events(world, me) & WHOLE
    mirrored, found = Mirrored(world), []
    for tick in range(400):
        input_ = {0: EAST, 80: EAST._replace(buttons=1), 84: EAST}.get(tick)
        world.step(None if input_ is None else {me: input_})
        found.append(events(world, me))
        mirrored.send()
        mirrored.check()
    assert [what for what in found if what][:7] == [
        TOLD | NEW_MOVE,  # walks
        STOP_X,  # reaches the wall
        TOLD | NEW_BUTTONS | LAUNCH | STOP_X,  # jumps, still at the wall
        TOLD | NEW_BUTTONS | STOP_X,  # the jump key is released
        GO_X,  # is above the wall
        STOP_Z,  # lands
        FALL | WHOLE,  # falls off the edge, into the segment below
    ]


def test_holding_a_course_costs_nothing(compiled: bool) -> None:
    world = build([floor(0, 30)], compiled=compiled)
    me = world.spawn("box", (-20, 5, 0))
    steps(world, 10, {me: EAST})
    mirrored = Mirrored(world)
    for _ in range(200):
        world.step({me: EAST})
        mirrored.send()
    assert (mirrored.turns, mirrored.sent_turns, mirrored.bytes) == (200, 0, 0)
    world.step({me: JUMP})
    mirrored.send()
    assert mirrored.bytes == 12, "5 for the part, 2 for the field, 2 for id and events, 3 for the input"
    mirrored.check()


def test_what_each_kind_of_change_costs(compiled: bool) -> None:
    """The part of a segment with turns takes 7 bytes without them."""
    world = build([floor(0, 8), [3, -9, 0, 4, 9, 1, 1]], compiled=compiled)
    me = world.spawn("box", (0, 0, 0))
    steps(world, 3)
    mirrored, costs = Mirrored(world), []
    for tick in range(200):
        input_ = {0: EAST, 80: Input(127, 1), 81: Input(127, 1, 2), 82: Input(0, 1, 0), 83: NEUTRAL}.get(tick)
        world.step(None if input_ is None else {me: input_})
        before = mirrored.bytes
        mirrored.send()
        mirrored.check()
        if mirrored.bytes > before:
            costs.append((events(world, me), mirrored.bytes - before - 7))
    assert costs == [
        (TOLD | NEW_MOVE, 3),
        (STOP_X, 3),  # at the wall
        (TOLD | NEW_MOVE | STOP_X, 5),
        (TOLD | NEW_BUTTONS | STOP_X, 4),
        (TOLD | NEW_MOVE | NEW_BUTTONS, 5),
        (TOLD | NEW_MOVE, 3),
    ]


@pytest.mark.parametrize(("offset", "size"), [((-0.3, 0.1, 0.7), (0.6, -1.7, 1.8)), ((-5.2, 3.1, -8), (9.9, 0.01, 7))])
def test_a_stop_at_a_block_is_exact_for_any_box(offset: Vec, size: Vec, compiled: bool) -> None:
    made = scene([], templates=(Template("odd", offset, size),), player="odd", gravity=0.0)
    world = World(made, compiled=compiled)
    world.load_terrain()
    world.spawn("odd", (-13.3, 10.7, -16.2))
    world.step()
    row, home = made.templates[0].row(), [part // SIDE for part in world.state(1)[X:VX]]
    for block, axis, side in product(range(SEGMENT), range(3), range(2)):
        stops = [0, 0, 0]
        stops[axis] = -1 - (block | side * EDGE_HIGH)
        assert world.follow(np.array([[1, STOP_X << axis, 0, 0, 0, *stops]], np.int64), 1, world.tick + 1)
        place = world.state(1)[X + axis]
        edge = place + row[axis] + side * row[3 + axis]
        assert (edge % BLOCK, edge // BLOCK % SEGMENT, place // SIDE) == (0, block, home[axis])


@pytest.mark.parametrize("n", [0, 1, 2, 40, 1500])
def test_changes_are_packed_in_the_order_of_ids_segment_by_segment(n: int, compiled: bool) -> None:
    rng = np.random.default_rng(n)
    matrix = np.zeros((n + 50, len(COLUMNS)), np.int64)
    rows = rng.permutation(n + 50)[:n]
    matrix[rows, ID] = rng.choice(np.arange(1, 1 << 20), n, replace=False)
    matrix[rows, TEMPLATE : FLAGS + 1] = rng.integers(0, 3, (n, 2))
    matrix[rows, X:VX] = rng.integers(-2 * SIDE, 2 * SIDE, (n, 3))
    matrix[rows, VX:MOVE_X] = rng.integers(-(1 << 30), 1 << 30, (n, 3))
    matrix[rows, MOVE_X:CELL] = rng.integers(-127, 128, (n, 3))
    matrix[rows, BUTTONS] &= 255
    matrix[rows, CHANGED] = 7 << EVENT_BITS | rng.integers(0, 2 * WHOLE, n) * rng.integers(0, 2, n)
    changed = np.concatenate((rows, np.flatnonzero(matrix[:, ID] == 0)[:20]))  # rows of entities that are gone, too
    acted = set(matrix[rows[::3], ID].tolist())
    lengths = np.zeros(LENGTHS, np.int64)
    lengths[N_CHANGED] = len(changed)
    rows_of_templates = np.zeros((3, TEMPLATE_COLUMNS), np.int64)
    rows_of_templates[:, LO_X : LO_X + 3] = rng.integers(-3 * BLOCK, BLOCK, (3, 3))
    rows_of_templates[:, SIZE_X : SIZE_X + 3] = rng.integers(1, 3 * BLOCK, (3, 3))
    for at, row in enumerate(matrix[rows]):  # half of the positions are at a block's face
        if at % 2:
            low, size = (rows_of_templates[row[TEMPLATE], k + at // 2 % 3] for k in (LO_X, SIZE_X))
            place = matrix[rows[at], X + at // 2 % 3] // BLOCK * BLOCK - low - (size if at % 4 == 1 else 0)
            matrix[rows[at], X + at // 2 % 3] = place
    lists = {"templates": rows_of_templates, "entities": matrix, "changed": np.append(changed, 0), "lengths": lengths}
    kernel = kernels.get(compiled)
    arrays = SimpleNamespace(**{name: kernel.lent(each) for name, each in lists.items()})
    world = SimpleNamespace(arrays=arrays, tick=7, kernel=kernel)
    shares, due = TickEncoder(world, 4).pack(acted)  # type: ignore[arg-type]
    sent: dict[Cell, list[Int64s]] = {}
    everywhere: set[Cell] = set()
    for row in sorted(matrix[rows], key=lambda row: int(row[ID])):
        x, y, z = (row[X:VX] // SIDE).tolist()
        everywhere.add((x, y, z))
        if row[CHANGED] & 2 * WHOLE - 1:
            sent.setdefault((x, y, z), []).append(row)
    assert due == {(x, y, z) for x, y, z in everywhere if (x + 3 * y + 5 * z + 7) % 4 == 0}
    assert {share.segment for share in shares} == sent.keys()
    assert len(shares) == len(sent)
    for segment, ids, whole, packed in shares:
        turns: list[list[int]] = []
        sent_whole = [row for row in sent[segment] if row[CHANGED] & WHOLE]
        for row in sent[segment]:
            events = int(row[CHANGED]) & 2 * WHOLE - 1
            if events < WHOLE:
                low, size = (rows_of_templates[row[TEMPLATE], k : k + 3] for k in (LO_X, SIZE_X))
                stops = map(stop_of, (row[X:VX] % SIDE).tolist(), low.tolist(), (low + size).tolist())
                turns.append([int(row[ID]), events, *row[MOVE_X:CELL].tolist(), *stops])
        assert packed == (pack_turns(turns), encode_rows(np.array(sent_whole).reshape(-1, len(COLUMNS)), acted))
        assert whole == [row[ID] for row in sent_whole]
        assert sorted(ids) == [row[ID] for row in sent[segment]]


# -- what no server sends -------------------------------------------------------------------------------------


def turn(entity: int, what: int, *rest: int) -> list[int]:
    return [entity, what, *rest, *[0] * (6 - len(rest))]


def test_a_turn_of_an_unknown_entity_is_reported_and_the_others_apply(compiled: bool) -> None:
    """The rows ascend by id or not. Unknown ids include one whose row is free again, and id 0, which free rows have."""
    world = build(compiled=compiled)
    for entity in (9, 3, 5):
        world.put([(entity, 0, 0, 2 * entity * BLOCK, 0, 9 * BLOCK, 0, 0, 0, 0, 0, 0)])
    world.remove(5)
    at_rest = world.state(3)
    for unknown in (0, 4, 5, 7, 10, 2**32 - 1):
        world.put([at_rest])
        assert not world.follow(np.array([turn(unknown, FALL), turn(3, FALL)], np.int64), 1, world.tick + 1)
        assert world.falling(3)
    assert world.follow(np.array([turn(9, FALL), turn(3, FALL)], np.int64), 1, world.tick + 1)
    assert world.falling(9)


@pytest.mark.parametrize("seed", range(4))
def test_with_any_turns_an_entity_stays_in_its_segment_and_the_kernel_in_its_tables(seed: int, compiled: bool) -> None:
    rng = random.Random(seed)
    world = build(compiled=compiled)
    for i in range(8):
        world.spawn(rng.choice(["box", "stone", "ghost"]), (i - 4, 0, 0))
    world.rebase(0)
    homes = world.states()[:, X : X + 3] // SIDE
    for _ in range(200):
        turns = [
            turn(
                entity, rng.randrange(256), rng.randint(-128, 127), rng.randint(-128, 127), rng.randrange(256),
                *(rng.randint(-(1 << 31), (1 << 31) - 1) for _ in range(3)),
            )
            for entity in range(1, 9)
        ]  # fmt: skip
        world.follow(np.array(turns, np.int64), 1, world.tick + 1)
        states = world.states()
        assert (states[:, X : X + 3] // SIDE == homes).all()
        assert (abs(states[:, MOVE_X:BUTTONS]) <= 127).all()
    other = World(world.scene, compiled=compiled)
    other.restore(world)
    steps(other, 3, {1: WEST, 2: NEUTRAL})
