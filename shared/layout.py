"""The memory layout of a world: the arrays that `World` and its kernel share.

An entity is a row of 16 int64, with the columns below.
"""

from typing import Any, NamedTuple

from shared.arrays import Int64s as Int64s

COLUMNS = "id template flags x y z vx vy vz move_x move_y buttons cell next prev changed".split()
"""Names of the columns of an entity's row."""
ID, TEMPLATE, FLAGS, X, Y, Z, VX, VY, VZ, MOVE_X, MOVE_Y, BUTTONS, CELL, NEXT, PREV, CHANGED = range(16)
"""Columns of an entity's row; the first 12 are its state. `id` is 0 in a free row. Position and velocity are in grid
steps. `cell` is the entity's cell in the entity index (-1: none), and `next` and `prev` are its neighbour rows in that
cell. `changed` is `tick << EVENT_BITS | events`: the tick that last changed the entity, and the events of that tick,
which a client cannot extrapolate (`kernel.advance`)."""

WIDTH_SHIFT = 4
"""Shift from an entity's row to its start in the kernel's flat view: row r begins at r << WIDTH_SHIFT."""

FALLING = 1
"""Flag of an entity: gravity acts on it."""
AWAKE = 2
"""Flag of an entity, for bookkeeping: the row is in the list of awake entities."""

EVENT_BITS = 10
"""Number of bits for the events of a turn. The first eight are sent."""
STOP_X, STOP_Y, STOP_Z, GO_X, GO_Y, FALL, LAUNCH, TOLD, WHOLE, CARRIED = (1 << bit for bit in range(EVENT_BITS))
"""Events of a turn. STOP_X, STOP_Y, STOP_Z: it stopped along that axis. GO_X, GO_Y: it begins to move along that axis
without a new input, as its input says. FALL: nothing supports it any more. LAUNCH: it jumped. TOLD: it has a new input.
WHOLE: it was written from outside, or came into another segment, so its whole state is needed. CARRIED: an entity on
which it stands moved it in this tick."""
NEW_MOVE, NEW_BUTTONS = GO_X, GO_Y
"""Meaning of two bits beside TOLD, which includes GO_X and GO_Y: the parts of the input that are new."""
TURN = 8
"""Number of columns of an explicit turn: id (for the kernel: row, or -1), events, input (3), position (3). A position
from 0 on counts from the low corner of the segment. A negative one is -1 - (block | EDGE_HIGH or 0): the entity's box
touches the low plane of this block of its segment with its high or its low side."""
EDGE_HIGH = 32
"""Bit of a negative position in an explicit turn: the high side of the box touches the block's low plane."""

LO_X, LO_Y, LO_Z, SIZE_X, SIZE_Y, SIZE_Z, SOLID, WALKS, JUMP_SPEED, WEIGHT, TOP_SQUARE, GROUND, AIR, CARRIES = (
    *range(12), 14, 17,
)  # fmt: skip
"""Columns of a template's row. LO and SIZE: low corner of the box relative to the position, and its sides, in grid
steps. SOLID, WALKS: 0 or 1. JUMP_SPEED: in velocity steps. WEIGHT: change of the velocity by gravity, in velocity steps
per tick; 0: the entity floats. TOP_SQUARE: square of the greatest walking speed in velocity steps; 0: the horizontal
velocity follows the input at once, and the columns behind have no meaning. GROUND: the first of three columns, each
the greatest change of the horizontal velocity in velocity steps per tick: with an input (SPEED_UP), without one
(SLOW_DOWN), and above the walking speed (OVERSPEED). AIR: the first of the three for an entity that falls.
CARRIES: 0 or 1."""
SPEED_UP, SLOW_DOWN, OVERSPEED = range(3)
"""Offsets from the columns GROUND and AIR."""
TEMPLATE_COLUMNS = 18
"""Number of columns of a template's row."""

GRAVITY, TERMINAL, RATE, EXACT, MEAN, PAIRS, FLOOR = range(7)
"""Places of a scene's numbers in `Arrays.parameters`. GRAVITY: 1 if gravity acts on any template. TERMINAL: greatest
fall speed, in velocity steps. RATE: ticks per second. EXACT: 128 / RATE if that is a whole number, else 0. MEAN: 1 for
the integrator "mean". PAIRS: 1 if solid entities stop each other. FLOOR: lowest z of the scene, in blocks."""
REACH_LO, REACH_HI = 7, 10
"""Places in `Arrays.parameters` of how far any template's box reaches below and above its position, three numbers each,
in grid steps."""
PARAMETERS = 13
"""Number of values in `Arrays.parameters`."""

N_AWAKE, N_WOKEN, N_CHANGED, N_FELL, N_LATER, N_HOMELESS, N_STEPPED = range(7)
"""Places of the lists' lengths in `Arrays.lengths`. N_HOMELESS: number of entities in no loaded segment. N_STEPPED: 1
if nothing has changed since the latest step."""
LENGTHS = 7
"""Number of values in `Arrays.lengths`."""

CELL_SHIFT = 2
"""Shift from blocks to a cell of the entity index, along x and y."""
CELL_SHIFT_Z = 4
"""Shift from blocks to a cell of the entity index, along z. A cell is 4 x 4 x 16 blocks, because crowds spread on the
ground; a segment has 8 x 8 x 2 cells."""
CELLS_SHIFT = 7
"""Shift from a segment's row to its first cell."""
CELLS = 1 << CELLS_SHIFT
"""Number of cells of a segment."""
CANDIDATE = 7
"""Number of columns of a candidate: low corner (3), high corner (3), row."""
RIDER = 2
"""Number of columns of an entry of `Arrays.riders`."""
NOWHERE = 0
"""Segment row whose cells hold the entities of all segments that are not loaded; these are still obstacles."""


class Arrays(NamedTuple):
    """The arrays that the kernel reads and writes: flat, int64 unless stated otherwise; memoryviews for plain Python.

    Sizes stand in brackets.
    """

    entities: Any  # [rows * 16]
    templates: Any  # [templates * 18]
    walk: Any  # [templates * 255] velocity for a move intent of -127..127
    parameters: Any  # [13]
    solid: Any  # uint32 [segments * 1024] bit x of word z << 5 | y within the segment
    segments: Any  # [segments * 3] index of each loaded segment
    table: Any  # [power of two] open addressing: segment row + 1, 0 is empty
    heads: Any  # int32 [segments * 128] first entity row of each cell, -1 is empty
    awake: Any  # [rows + 1] keys (id << 32 | row) of the entities that have a turn, ascending
    next_awake: Any  # [rows + 1] keys of the entities that have a turn in the next tick, while it is built
    woken: Any  # [rows + 1] heap of keys that join the awake ones
    later: Any  # [rows + 1] keys of entities that were woken after their turn had passed
    candidates: Any  # [(rows + 1) * 7] box and row of the entities near the one that has its turn
    changed: Any  # [rows + 1] rows whose state the step changed
    fell: Any  # [rows + 1] ids of entities below the scene's floor
    lengths: Any  # [7] lengths of the lists, and other counts (N_AWAKE ...)
    near: Any  # [4] index and row of the segment that was looked up last
    riders: Any  # [(rows + 1) * 2] an entity that carries others, and these: row, and whether it stands on the first
