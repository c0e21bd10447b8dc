"""Small worlds for tests: a scene with some boxes of blocks in one line, and exact numbers.

Positions within +-2^28 blocks have at most 53 significant bits, so `World.position` is exact and the tests compare with
`==`.
"""

from collections.abc import Iterable
from fractions import Fraction
from typing import Any

from shared.inputs import Input
from shared.scene import Scene, Template
from shared.units import BLOCK, SEGMENT
from shared.world import World

STEP = 1 / BLOCK
"""One grid step, in blocks."""

EAST, WEST, NORTH, SOUTH = Input(127, 0), Input(-127, 0), Input(0, 127), Input(0, -127)
JUMP = Input(0, 0, 1)

TEMPLATES = (
    # the box of the hard cases: 5/8 x 5/8 x 7/4 with its low corner at the position
    Template("box", (0, 0, 0), (5 / 8, 5 / 8, 7 / 4), walk_speed=3, jump_speed=8),
    Template("stone", (0, 0, 0), (5 / 8, 5 / 8, 7 / 4)),
    Template("cube", (0, 0, 0), (1, 1, 1), walk_speed=3, jump_speed=8),
    Template("slab", (0, 0, 0), (4, 4, 1)),
    Template("ghost", (0, 0, 0), (5 / 8, 5 / 8, 7 / 4), walk_speed=3, jump_speed=8, solid=False),
    # intent (96, 64) is exactly 3 and 2 blocks/s
    Template("runner", (0, 0, 0), (5 / 8, 5 / 8, 7 / 4), walk_speed=127 / 32, jump_speed=8),
    Template("person", (-0.3, -0.3, 0), (0.6, 0.6, 1.8), walk_speed=3, jump_speed=8),
)

Fill = list[int]
"""Box of blocks: [x0, y0, z0, x1, y1, z1, kind]."""


def scene(fill: Iterable[Fill] = (), **changes: Any) -> Scene:
    """Returns the scene of the hard cases: dt = 1/64, g = v_t = 16; eight segments around the origin."""
    values: dict[str, Any] = {
        "name": "test",
        "templates": TEMPLATES,
        "player": "box",
        "tick_rate": 64,
        "gravity": 16.0,
        "terminal_speed": 16.0,
        "origin": (-1, -1, -1),
        "size": (2, 2, 2),
        "terrain": {"generator": "boxes", "fill": [list(entry) for entry in fill]},
    }
    return Scene(**(values | changes))


def build(fill: Iterable[Fill] = (), *, compiled: bool | None = None, **changes: Any) -> World:
    """Returns a world of `scene(fill, **changes)` with all its segments loaded."""
    world = World(scene(fill, **changes), compiled=compiled)
    world.load_terrain()
    return world


def floor(top: int = 0, half: int = 30, x: int = 0, y: int = 0) -> Fill:
    """Returns a floor one block thick around (x, y)."""
    return [x - half, y - half, top - 1, x + half, y + half, top, 1]


def around(*block: int) -> dict[str, Any]:
    """Returns the origin and size of a scene whose eight segments meet near a block."""
    return {"origin": tuple((part + SEGMENT // 2) // SEGMENT - 1 for part in block), "size": (2, 2, 2)}


def steps(world: World, n: int, inputs: dict[int, Input] | None = None) -> None:
    """Steps `n` ticks. The inputs are given in the first tick and last."""
    world.step(inputs)
    for _ in range(n - 1):
        world.step()


def settle(world: World, limit: int = 2000) -> int:
    """Steps until all entities sleep. Returns the number of ticks."""
    for tick in range(limit):
        if world.awake_count == 0:
            return tick
        world.step()
    raise AssertionError(f"{world.awake_count} entities still awake after {limit} ticks")


def high(world: World, entity: int) -> tuple[float, ...]:
    """Returns the high corner of an entity's box, in blocks."""
    return tuple(part / BLOCK for part in box(world, entity)[3:])


def low(world: World, entity: int) -> tuple[float, ...]:
    """Returns the low corner of an entity's box, in blocks."""
    return tuple(part / BLOCK for part in box(world, entity)[:3])


def box(world: World, entity: int) -> tuple[int, ...]:
    """Returns the corners of an entity's box in grid steps, from the template's own numbers."""
    state = world.state(entity)
    template = world.scene.templates[state[1]]
    lows, highs = [], []
    for k in range(3):
        ends = sorted((grid(template.box_offset[k]), grid(template.box_offset[k]) + grid(template.box_size[k])))
        lows.append(state[3 + k] + ends[0])
        highs.append(state[3 + k] + ends[1])
    return (*lows, *highs)


def grid(blocks: float | Fraction) -> int:
    """Returns blocks in grid steps, rounded by exact whole numbers; halves go away from zero."""
    count, parts = blocks.as_integer_ratio()
    whole = (2 * abs(count) * BLOCK + parts) // (2 * parts)
    return whole if blocks >= 0 else -whole


def states(world: World) -> list[tuple[int, ...]]:
    """Returns the state of every entity, ascending by id."""
    return [world.state(entity) for entity in world.entities["id"].tolist()]


def wake_all(world: World) -> None:
    """Gives every entity a turn in the next tick, as if none slept."""
    world.put(states(world))
