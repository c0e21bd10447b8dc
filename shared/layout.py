"""How a world lies in memory: the one struct between the world and its kernel.

Everything that moves is a row of 16 int64, so that the kernel sees a plain matrix, numpy sees a structured
array, and both name a column alike.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

COLUMNS = "id template flags x y z vx vy vz move_x move_y buttons cell next prev changed".split()
ID, TEMPLATE, FLAGS, X, Y, Z, VX, VY, VZ, MOVE_X, MOVE_Y, BUTTONS, CELL, NEXT, PREV, CHANGED = range(16)
ENTITY = np.dtype([(name, np.int64) for name in COLUMNS])
"""An entity. `id` 0 is a free row; position and velocity in grid steps; `cell` its place in the index of
cells (-1: none) with its `next` and `prev` neighbour rows; `changed` the tick that last changed it, and above
what was to be foreseen of that (`tick << EVENT_BITS | events`; see `kernel.advance`)."""

WIDTH_SHIFT = 4
"""In the kernel's flat view the row r of an entity begins at r << WIDTH_SHIFT."""

FALLING = 1
"""Flag: gravity acts."""
AWAKE = 2
"""Flag (bookkeeping): the row is in the list of the awake."""

EVENT_BITS = 9
STOP_X, STOP_Y, STOP_Z, GO_X, GO_Y, FALL, LAUNCH, TOLD, WHOLE = (1 << bit for bit in range(EVENT_BITS))
"""What a turn decided: stopped along an axis, walks as wished again, nothing stands under it, jumped; its wish is
another one; it was written from outside or came into another segment."""
TURN = 8
"""Numbers of a turn that is told: id (to the kernel: row, or -1), events, the wish (3), the position (3)."""

# A template's row: the box relative to the position, and what it may do.
LO_X, LO_Y, LO_Z, SIZE_X, SIZE_Y, SIZE_Z, SOLID, WALKS, JUMP_SPEED = range(9)
TEMPLATE_COLUMNS = 9

# The numbers of a scene that the kernel needs.
GRAVITY, TERMINAL, RATE, EXACT, MEAN, PAIRS, FLOOR = range(7)  # FLOOR: the lowest z, in blocks
REACH_LO, REACH_HI = 7, 10  # how far any box reaches below and above its position, three columns each
PARAMETERS = 13

# Lengths of the lists that the kernel keeps.
N_AWAKE, N_WOKEN, N_CHANGED, N_FELL, N_LATER, N_HOMELESS, N_STEPPED = range(7)
LENGTHS = 7

CELL_SHIFT = 2
CELL_SHIFT_Z = 4
"""A cell of the entity index is 4 x 4 x 16 blocks: crowds spread on the ground; a segment has 8 x 8 x 2 of them."""
CELLS_SHIFT = 7
CELLS = 1 << CELLS_SHIFT
CANDIDATE = 7
"""Numbers of a candidate: low corner, high corner, row."""
NOWHERE = 0
"""The segment row whose cells hold the entities of all segments that are not loaded: they are still obstacles."""

Int64s = npt.NDArray[np.int64]


class Arrays(NamedTuple):
    """All that `kernel.step` reads and writes: int64 unless said (flat arrays, or memoryviews for the plain source)."""

    entities: Any  # [rows * 16]
    templates: Any  # [templates * 9]
    walk: Any  # [templates * 255] velocity for a move intent of -127..127
    parameters: Any  # [13]
    solid: Any  # uint32 [segments * 1024] bit x of word z << 5 | y within the segment
    segments: Any  # [segments * 3] index of each loaded segment
    table: Any  # [power of two] open addressing: segment row + 1, 0 is empty
    heads: Any  # int32 [segments * 128] first entity row of each cell, -1 is empty
    awake: Any  # [rows + 1] keys (id << 32 | row), ascending: whose turn it is
    next_awake: Any  # [rows + 1] the same for the next tick, in the making
    woken: Any  # [rows + 1] heap of keys that join the awake
    later: Any  # [rows + 1] keys woken after their turn had passed
    candidates: Any  # [(rows + 1) * 7] box and row of the entities near the one whose turn it is
    changed: Any  # [rows + 1] rows whose state the step changed
    fell: Any  # [rows + 1] ids below the scene's floor
    lengths: Any  # [7]; N_HOMELESS counts the entities nowhere, N_STEPPED says nothing changed since a step
    near: Any  # [4] the segment looked up last: index and row
