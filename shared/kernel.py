"""The kernel: the step of a world. No other code moves an entity.

Theory of operation. `step` gives every awake entity a turn, in ascending order of id. A turn is

    input  ->  supported?  ->  gravity, friction  ->  move along z, x, y, each to the first obstacle  ->  stays awake?

Entities that sleep are not examined. An event that could make a sleeping entity move wakes it (`wake`): a block or an
entity under it goes away, or it is written. An entity that was woken by one with a lower id has its turn in the same
tick, exactly as if it had been awake before. So sleep does not change the results, and an entity that sleeps costs no
time.

A move is swept: along one axis, the leading face passes the layers of blocks and the faces of solid entities that it
newly reaches, and stops *on* the first one. The numbers are whole grid steps, so "on" means equality. A box that
overlapped nothing overlaps nothing afterwards, at any speed, with no epsilon and no second pass. An obstacle that the
box already overlaps does not stop it, so the box can get out. Rejected: the rewind along the whole velocity (loses 93 %
of the motion along a wall), and merged slabs (4 times slower than the dense look-up, and a sliding box catches on their
seams).

Where a template has an acceleration or a friction, the horizontal velocity approaches the wished one as a vector, by a
bounded step per tick (`pace`, `toward`). `advance`, which has no surroundings, computes the same from the state alone.
It relies on two facts: a part of a velocity that is not 0 always moves the entity or is stopped, and a part that is 0
stays 0 without an event.

An entity that carries others (`layout.CARRIES`) moves them in its own turn: first it, then along each axis all that
stand on it and on each other, the foremost first. Upwards they move together, as far as all of them can. So they keep
their places on it exactly, whatever the order of ids. An entity that stands on two carriers is carried by the first
that moves. Rejected: riders that add the carrier's motion in their own turn. They would lag behind by a tick where
their id is lower, and a lift could not rise under them.

This source runs compiled by Numba and, unchanged, in plain Python (`shared.kernels`), so it uses whole numbers, loops
and comparisons only. In all functions, `w` has the arrays of the world (`shared.layout`), `x0, y0, z0` is the low
corner of a box and `x1, y1, z1` its high one, in grid steps.
"""

from typing import Any

from shared.inputs import JUMP, MOVE_MAX
from shared.jit import decorators
from shared.layout import (
    AIR,
    AWAKE,
    BUTTONS,
    CANDIDATE,
    CARRIED,
    CARRIES,
    CELL,
    CELL_SHIFT,
    CELL_SHIFT_Z,
    CELLS,
    CELLS_SHIFT,
    CHANGED,
    EDGE_HIGH,
    EVENT_BITS,
    EXACT,
    FALL,
    FALLING,
    FLAGS,
    FLOOR,
    GO_X,
    GO_Y,
    GRAVITY,
    GROUND,
    ID,
    JUMP_SPEED,
    LAUNCH,
    LO_X,
    MEAN,
    MOVE_X,
    MOVE_Y,
    N_AWAKE,
    N_CHANGED,
    N_FELL,
    N_HOMELESS,
    N_LATER,
    N_STEPPED,
    N_WOKEN,
    NEW_BUTTONS,
    NEW_MOVE,
    NEXT,
    NOWHERE,
    OVERSPEED,
    PAIRS,
    PREV,
    RATE,
    REACH_HI,
    REACH_LO,
    RIDER,
    SIZE_X,
    SLOW_DOWN,
    SOLID,
    SPEED_UP,
    STOP_X,
    STOP_Y,
    STOP_Z,
    TEMPLATE,
    TEMPLATE_COLUMNS,
    TERMINAL,
    TOLD,
    TOP_SQUARE,
    TURN,
    VX,
    VY,
    VZ,
    WALKS,
    WEIGHT,
    WHOLE,
    WIDTH_SHIFT,
    Arrays,
    X,
    Y,
    Z,
)  # fmt: skip
from shared.units import BLOCK, BLOCK_SHIFT, IN_SEGMENT, SEGMENT_SHIFT, TO_SEGMENT

jit, inlined = decorators(__name__)

ROW_BITS = 32
"""Number of low bits of a key that hold the row; the bits above hold the id."""
ROW_MASK = (1 << ROW_BITS) - 1
"""Mask of a key's row."""
INSIDE = (1 << SEGMENT_SHIFT) - 1
"""Mask of a block's place within its segment, along one axis."""
TO_CELL = BLOCK_SHIFT + CELL_SHIFT
"""Shift from grid steps to cells, along x and y."""
TO_CELL_Z = BLOCK_SHIFT + CELL_SHIFT_Z
"""Shift from grid steps to cells, along z."""
CELL_TO_SEGMENT = SEGMENT_SHIFT - CELL_SHIFT
"""Shift from cells to segments, along x and y."""
CELL_TO_SEGMENT_Z = SEGMENT_SHIFT - CELL_SHIFT_Z
"""Shift from cells to segments, along z."""
MOVES = 2 * MOVE_MAX + 1
"""Number of walk velocities per template: one for each part of a direction, -127 to 127."""
FAR_AWAY = 1 << 60
"""Coordinate that no box reaches, in grid steps."""


# -- looking things up ---------------------------------------------------------------------------------------


@inlined
def segment_row(w: Arrays, x: int, y: int, z: int) -> int:
    """Returns the row of a segment, or NOWHERE if it is not loaded. The latest answer is kept in `near`."""
    near = w.near
    if near[0] == x and near[1] == y and near[2] == z:
        return near[3]
    return find_segment(w.table, w.segments, near, x, y, z)


@jit
def find_segment(table: Any, segments: Any, near: Any, x: int, y: int, z: int) -> int:
    """Looks a segment up in the hash table, keeps the answer in `near`, and returns its row or NOWHERE."""
    mask = len(table) - 1
    at = (x * 73856093 ^ y * 19349663 ^ z * 83492791) & mask
    row = NOWHERE
    while table[at] != 0:
        found = table[at] - 1
        if segments[3 * found] == x and segments[3 * found + 1] == y and segments[3 * found + 2] == z:
            row = found
            break
        at = (at + 1) & mask
    near[0] = x
    near[1] = y
    near[2] = z
    near[3] = row
    return row


@inlined
def solid_in(w: Arrays, x0: int, y0: int, z0: int, x1: int, y1: int, z1: int) -> bool:
    """Returns whether any of the blocks between two corners, both included, is an obstacle. Corners are in blocks.

    A block that is not loaded is an obstacle, except for the void below the scene's floor.
    """
    for z in range(z0, z1 + 1):
        for y in range(y0, y1 + 1):
            x = x0
            while x <= x1:
                last = min(x1, x | INSIDE)  # blocks x to last are in one segment, and so in one word
                row = segment_row(w, x >> SEGMENT_SHIFT, y >> SEGMENT_SHIFT, z >> SEGMENT_SHIFT)
                if row == NOWHERE:
                    if z >= w.parameters[FLOOR]:
                        return True
                else:
                    asked = ((2 << (last - x)) - 1) << (x & INSIDE)
                    if w.solid[row << 10 | (z & INSIDE) << 5 | (y & INSIDE)] & asked != 0:
                        return True
                x = last + 1
    return False


@jit
def blocks_in(w: Arrays, x0: int, y0: int, z0: int, x1: int, y1: int, z1: int) -> bool:
    """Returns whether a solid block overlaps the open box between two corners, in grid steps."""
    return solid_in(
        w,
        x0 >> BLOCK_SHIFT, y0 >> BLOCK_SHIFT, z0 >> BLOCK_SHIFT,
        (x1 - 1) >> BLOCK_SHIFT, (y1 - 1) >> BLOCK_SHIFT, (z1 - 1) >> BLOCK_SHIFT,
    )  # fmt: skip


@jit
def gather(w: Arrays, but: int, solid: bool, x0: int, y0: int, z0: int, x1: int, y1: int, z1: int) -> int:
    """Writes the entities that overlap or touch a box to `candidates`, without the row `but`.

    With `solid`, only solid entities count. Returns the number of values written, 7 per entity.
    """
    p, e, t, found = w.parameters, w.entities, w.templates, w.candidates
    n = 0
    for cz in range((z0 - p[REACH_HI + 2]) >> TO_CELL_Z, ((z1 + p[REACH_LO + 2]) >> TO_CELL_Z) + 1):
        for cy in range((y0 - p[REACH_HI + 1]) >> TO_CELL, ((y1 + p[REACH_LO + 1]) >> TO_CELL) + 1):
            for cx in range((x0 - p[REACH_HI]) >> TO_CELL, ((x1 + p[REACH_LO]) >> TO_CELL) + 1):
                cell = cell_at(w, cx, cy, cz)
                row = w.heads[cell]
                while row >= 0:
                    at = row << WIDTH_SHIFT
                    kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
                    here = cell >= CELLS or (
                        e[at + X] >> TO_CELL == cx and e[at + Y] >> TO_CELL == cy and e[at + Z] >> TO_CELL_Z == cz
                    )
                    if here and row != but and (not solid or t[kind + SOLID] != 0):
                        x = e[at + X] + t[kind + LO_X]
                        y = e[at + Y] + t[kind + LO_X + 1]
                        z = e[at + Z] + t[kind + LO_X + 2]
                        hx = x + t[kind + SIZE_X]
                        hy = y + t[kind + SIZE_X + 1]
                        hz = z + t[kind + SIZE_X + 2]
                        if x <= x1 and hx >= x0 and y <= y1 and hy >= y0 and z <= z1 and hz >= z0:
                            found[n] = x
                            found[n + 1] = y
                            found[n + 2] = z
                            found[n + 3] = hx
                            found[n + 4] = hy
                            found[n + 5] = hz
                            found[n + 6] = row
                            n += CANDIDATE
                    row = e[at + NEXT]
    return n


# -- the index of cells --------------------------------------------------------------------------------------


@inlined
def cell_at(w: Arrays, x: int, y: int, z: int) -> int:
    """Returns the number of a cell in `heads`, from its place among all cells of the world."""
    segment = segment_row(w, x >> CELL_TO_SEGMENT, y >> CELL_TO_SEGMENT, z >> CELL_TO_SEGMENT_Z)
    return segment << CELLS_SHIFT | (z & 1) << 6 | (y & 7) << 3 | (x & 7)


@jit
def unlink(w: Arrays, row: int) -> None:
    """Removes an entity from its cell, if it is in one."""
    e = w.entities
    at = row << WIDTH_SHIFT
    cell = e[at + CELL]
    if cell < 0:
        return
    before = e[at + PREV]
    after = e[at + NEXT]
    if before >= 0:
        e[(before << WIDTH_SHIFT) + NEXT] = after
    else:
        w.heads[cell] = after
    if after >= 0:
        e[(after << WIDTH_SHIFT) + PREV] = before
    e[at + CELL] = -1
    if cell < CELLS:
        w.lengths[N_HOMELESS] -= 1


@jit
def relink(w: Arrays, row: int) -> None:
    """Moves an entity to the cell of its position, if it is not in it already."""
    e = w.entities
    at = row << WIDTH_SHIFT
    cell = cell_at(w, e[at + X] >> TO_CELL, e[at + Y] >> TO_CELL, e[at + Z] >> TO_CELL_Z)
    if cell == e[at + CELL]:
        return
    unlink(w, row)
    first = w.heads[cell]
    e[at + CELL] = cell
    e[at + PREV] = -1
    e[at + NEXT] = first
    if first >= 0:
        e[(first << WIDTH_SHIFT) + PREV] = row
    w.heads[cell] = row
    if cell < CELLS:
        w.lengths[N_HOMELESS] += 1


@jit
def relink_range(w: Arrays, start: int, stop: int) -> None:
    """Moves the entities of the rows from `start` up to `stop` (excluded) to the cells of their positions."""
    for row in range(start, stop):
        if w.entities[(row << WIDTH_SHIFT) + ID] != 0:
            relink(w, row)


# -- waking --------------------------------------------------------------------------------------------------


@jit
def push(heap: Any, n: int, key: int) -> None:
    """Adds `key` to a heap of `n` keys, with the least on top."""
    while n > 0:
        parent = (n - 1) >> 1
        if heap[parent] <= key:
            break
        heap[n] = heap[parent]
        n = parent
    heap[n] = key


@jit
def pop(heap: Any, n: int) -> int:
    """Removes the least key from a heap of `n` keys, and returns it."""
    least = heap[0]
    n -= 1
    key = heap[n]
    at = 0
    while True:
        child = 2 * at + 1
        if child >= n:
            break
        if child + 1 < n and heap[child + 1] < heap[child]:
            child += 1
        if heap[child] >= key:
            break
        heap[at] = heap[child]
        at = child
    heap[at] = key
    return least


@inlined
def wake(w: Arrays, row: int, turn: int) -> None:
    """Wakes an entity that sleeps: it has a turn in this tick if its key is above `turn`, else in the next tick."""
    e, n = w.entities, w.lengths
    at = row << WIDTH_SHIFT
    if e[at + FLAGS] & AWAKE:
        return
    e[at + FLAGS] |= AWAKE
    key = e[at + ID] << ROW_BITS | row
    if key > turn:
        push(w.woken, n[N_WOKEN], key)
        n[N_WOKEN] += 1
    else:
        w.later[n[N_LATER]] = key
        n[N_LATER] += 1


@jit
def wake_riders(w: Arrays, n: int, x0: int, y0: int, x1: int, y1: int, top: int, turn: int) -> None:
    """Wakes the candidates that stand on the face from (x0, y0) to (x1, y1) at the height `top`.

    `n` is the number of values in `candidates`, and `turn` the key of the entity that has its turn (-1: none).
    """
    c = w.candidates
    for m in range(0, n, CANDIDATE):
        if c[m + 2] == top and c[m] < x1 and c[m + 3] > x0 and c[m + 1] < y1 and c[m + 4] > y0:
            wake(w, c[m + 6], turn)


@jit
def wake_on(w: Arrays, but: int, x0: int, y0: int, x1: int, y1: int, top: int) -> None:
    """Wakes the entities that stand on a face that is about to go; `but` is the row of the face's owner, or -1."""
    wake_riders(w, gather(w, but, False, x0, y0, top, x1, y1, top), x0, y0, x1, y1, top, -1)


@jit
def wake_in(w: Arrays, x0: int, y0: int, z0: int, x1: int, y1: int, z1: int) -> None:
    """Wakes the entities that overlap or touch a box."""
    for m in range(0, gather(w, -1, False, x0, y0, z0, x1, y1, z1), CANDIDATE):
        wake(w, w.candidates[m + 6], -1)


# -- the turn of one entity ----------------------------------------------------------------------------------


@inlined
def displacement(p: Any, velocity_sum: int) -> int:
    """Returns the displacement of one tick in grid steps, from the sum of the old and the new velocity.

    Halves are rounded away from zero.
    """
    if p[EXACT] != 0:
        return velocity_sum * p[EXACT]
    rate = p[RATE]
    if velocity_sum >= 0:
        return (velocity_sum * 256 + rate) // (2 * rate)
    return -((rate - velocity_sum * 256) // (2 * rate))


@inlined
def length(x: int, y: int) -> int:
    """Returns the length of a vector, rounded down. Its parts are below 2^31."""
    x = abs(x)
    y = abs(y)
    square = x * x + y * y
    root = max(x, y) + (min(x, y) + 1) // 2  # at least the length, so that Newton's method falls to the result
    while root > 0:
        closer = (root + square // root) // 2
        if closer >= root:
            break
        root = closer
    return root


@inlined
def pace(t: Any, kind: int, falling: int, walks: bool, vx: int, vy: int) -> int:
    """Returns by how much the horizontal velocity can change in this tick, in velocity steps.

    `t` has the templates, `kind` is the start of the entity's row there, and `walks` says whether it has a direction.
    """
    column = SLOW_DOWN
    if walks:
        column = OVERSPEED if vx * vx + vy * vy > t[kind + TOP_SQUARE] else SPEED_UP
    rate: int = t[kind + (GROUND if falling == 0 else AIR) + column]
    return rate


@inlined
def toward(v: int, wish: int, rate: int, away: int) -> int:
    """Returns one part of a velocity that approaches a wished one by at most `rate`.

    `away` is the length of the whole difference. The step is rounded to the nearest whole number, so it never vanishes
    along all axes and never passes the wish. It is the same for mirrored vectors.
    """
    if away <= rate:
        return wish
    step = (2 * abs(wish - v) * rate + away) // (2 * away)
    return v + step if wish > v else v - step


@inlined
def stands_on_block(w: Arrays, x0: int, y0: int, x1: int, y1: int, z: int) -> bool:
    """Returns whether a solid block touches the underside of a box on an area, not only at an edge."""
    if z & (BLOCK - 1) != 0:
        return False
    below = (z >> BLOCK_SHIFT) - 1
    return solid_in(
        w, x0 >> BLOCK_SHIFT, y0 >> BLOCK_SHIFT, below, (x1 - 1) >> BLOCK_SHIFT, (y1 - 1) >> BLOCK_SHIFT, below
    )


@inlined
def stands_on_entity(w: Arrays, row: int, x0: int, y0: int, x1: int, y1: int, z: int) -> bool:
    """Returns whether a solid entity touches the underside of a box on an area, not only at an edge."""
    c = w.candidates
    for m in range(0, gather(w, row, True, x0, y0, z, x1, y1, z), CANDIDATE):
        if c[m + 5] == z and c[m] < x1 and c[m + 3] > x0 and c[m + 1] < y1 and c[m + 4] > y0:
            return True
    return False


@inlined
def layer_solid(w: Arrays, k: int, layer: int, i0: int, i1: int, j0: int, j1: int) -> bool:
    """Returns whether a layer of blocks across axis k has a solid block, within i0..i1 and j0..j1.

    i0 to i1 is along axis k+1 and j0 to j1 along axis k+2, in grid steps.
    """
    i0 >>= BLOCK_SHIFT
    i1 = (i1 - 1) >> BLOCK_SHIFT
    j0 >>= BLOCK_SHIFT
    j1 = (j1 - 1) >> BLOCK_SHIFT
    if k == 0:
        return solid_in(w, layer, i0, j0, layer, i1, j1)
    if k == 1:
        return solid_in(w, j0, layer, i0, j1, layer, i1)
    return solid_in(w, i0, j0, layer, i1, j1, layer)


@inlined
def sweep(w: Arrays, k: int, d: int, n: int, a0: int, a1: int, i0: int, i1: int, j0: int, j1: int) -> int:
    """Returns how far a box can move along axis k, at most d, up to the first obstacle, in grid steps.

    The box reaches from a0 to a1 along axis k, from i0 to i1 along axis k+1 and from j0 to j1 along axis k+2. `n` is
    the number of values in `candidates`.
    """
    sign = 1 if d > 0 else -1
    lead = a1 - 1 if d > 0 else a0
    layer = lead >> BLOCK_SHIFT
    last = (lead + d) >> BLOCK_SHIFT
    while layer != last:
        layer += sign
        if layer_solid(w, k, layer, i0, i1, j0, j1):
            d = (layer << BLOCK_SHIFT) - a1 if d > 0 else ((layer + 1) << BLOCK_SHIFT) - a0
            break
    c = w.candidates
    i = (k + 1) % 3
    j = (k + 2) % 3
    for m in range(0, n, CANDIDATE):
        if c[m + i] < i1 and c[m + i + 3] > i0 and c[m + j] < j1 and c[m + j + 3] > j0:
            if d > 0:
                if c[m + k] >= a1:
                    d = min(d, c[m + k] - a1)
            elif c[m + k + 3] <= a0:
                d = max(d, c[m + k + 3] - a0)
    return d


# -- carrying ------------------------------------------------------------------------------------------------


@jit
def among(w: Arrays, n: int, row: int) -> bool:
    """Returns whether a row is among the first `n` of `riders`."""
    i = 0
    while i < n * RIDER and w.riders[i] != row:
        i += RIDER
    return bool(i < n * RIDER)


@jit
def others(w: Arrays, riders: int, n: int) -> None:
    """Takes the first `riders` of `riders` out of the `n` values in `candidates`, so that they stop nothing."""
    c = w.candidates
    for m in range(0, n, CANDIDATE):
        if among(w, riders, c[m + 6]):
            for k in range(3):
                c[m + k] = FAR_AWAY
                c[m + k + 3] = -FAR_AWAY


@jit
def board(w: Arrays, row: int, tick: int) -> int:
    """Writes an entity that carries others to `riders`, and after it all that stand on it, directly or on each other.

    An entity that another one carried in this tick does not count as standing directly on this one. Returns the number
    of entries.
    """
    e, t, c, riders = w.entities, w.templates, w.candidates, w.riders
    riders[0] = row
    riders[1] = 0
    count = 1
    i = 0
    while i < count:
        at = riders[i * RIDER] << WIDTH_SHIFT
        kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
        x0 = e[at + X] + t[kind + LO_X]
        y0 = e[at + Y] + t[kind + LO_X + 1]
        x1 = x0 + t[kind + SIZE_X]
        y1 = y0 + t[kind + SIZE_X + 1]
        top = e[at + Z] + t[kind + LO_X + 2] + t[kind + SIZE_X + 2]
        for m in range(0, gather(w, riders[i * RIDER], True, x0, y0, top, x1, y1, top), CANDIDATE):
            if c[m + 2] == top and c[m] < x1 and c[m + 3] > x0 and c[m + 1] < y1 and c[m + 4] > y0:
                changed = e[(c[m + 6] << WIDTH_SHIFT) + CHANGED]
                carried = changed >> EVENT_BITS == tick and changed & CARRIED != 0
                if (i > 0 or not carried) and not among(w, count, c[m + 6]):
                    riders[count * RIDER] = c[m + 6]
                    riders[count * RIDER + 1] = int(i == 0)
                    count += 1
        i += 1
    return count


@jit
def swept(w: Arrays, riders: int, row: int, k: int, d: int) -> int:
    """Returns how far an entity can move along axis k, at most d, without the first `riders` of `riders` in its way."""
    e, t = w.entities, w.templates
    at = row << WIDTH_SHIFT
    kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
    x0 = e[at + X] + t[kind + LO_X]
    y0 = e[at + Y] + t[kind + LO_X + 1]
    z0 = e[at + Z] + t[kind + LO_X + 2]
    x1 = x0 + t[kind + SIZE_X]
    y1 = y0 + t[kind + SIZE_X + 1]
    z1 = z0 + t[kind + SIZE_X + 2]
    dx = d if k == 0 else 0
    dy = d if k == 1 else 0
    dz = d if k == 2 else 0
    n = gather(
        w, row, True,
        x0 + min(dx, 0), y0 + min(dy, 0), z0 + min(dz, 0), x1 + max(dx, 0), y1 + max(dy, 0), z1 + max(dz, 0),
    )  # fmt: skip
    others(w, riders, n)
    if k == 1:
        x0, x1, y0, y1, z0, z1 = y0, y1, z0, z1, x0, x1
    elif k == 2:
        x0, x1, y0, y1, z0, z1 = z0, z1, x0, x1, y0, y1
    return sweep(w, k, d, n, x0, x1, y0, y1, z0, z1)


@jit
def lift(w: Arrays, riders: int, d: int) -> int:
    """Returns how far all riders can move up together, at most d, in grid steps."""
    for i in range(1, riders):
        d = swept(w, riders, w.riders[i * RIDER], 2, d)
        if d == 0:
            break
    return d


@jit
def shift(w: Arrays, row: int, direct: int, k: int, d: int, key: int, tick: int) -> None:
    """Moves a rider along axis k. Wakes it and those that stand on it, and notes the events of its move.

    An entity at rest is sent as one that stopped at its new place. Any other is sent whole.
    """
    e, t = w.entities, w.templates
    at = row << WIDTH_SHIFT
    kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
    x0 = e[at + X] + t[kind + LO_X]
    y0 = e[at + Y] + t[kind + LO_X + 1]
    x1 = x0 + t[kind + SIZE_X]
    y1 = y0 + t[kind + SIZE_X + 1]
    top = e[at + Z] + t[kind + LO_X + 2] + t[kind + SIZE_X + 2]
    wake_riders(w, gather(w, row, False, x0, y0, top, x1, y1, top), x0, y0, x1, y1, top, key)
    wake(w, row, key)
    before = e[at + X + k]
    e[at + X + k] = before + d
    events = STOP_X << k
    rests = e[at + VX] == 0 and e[at + VY] == 0 and e[at + VZ] == 0 and e[at + FLAGS] & FALLING == 0
    if not rests or (before ^ before + d) >> TO_SEGMENT != 0:
        events |= WHOLE
    if direct != 0:
        events |= CARRIED
    relink(w, row)
    mark(w, row, tick, events)


@jit
def leads(w: Arrays, a: int, b: int, k: int, d: int) -> bool:
    """Returns whether the entity at row `a` is ahead of that at row `b` in the direction of d along axis k.

    If their leading faces are equal, the lower id is ahead.
    """
    e, t = w.entities, w.templates
    at = a << WIDTH_SHIFT
    by = b << WIDTH_SHIFT
    kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
    face = e[at + X + k] + t[kind + LO_X + k] + (t[kind + SIZE_X + k] if d > 0 else 0)
    kind = e[by + TEMPLATE] * TEMPLATE_COLUMNS
    other = e[by + X + k] + t[kind + LO_X + k] + (t[kind + SIZE_X + k] if d > 0 else 0)
    if face != other:
        return bool((face > other) == (d > 0))
    return bool(e[at + ID] < e[by + ID])


@jit
def carry(w: Arrays, riders: int, k: int, d: int, key: int, tick: int) -> None:
    """Moves the riders along axis k by d, each up to the first obstacle, and the foremost first.

    Upwards they move together, because `lift` has found the way free.
    """
    r = w.riders
    for i in range(RIDER, riders * RIDER, RIDER):
        first = i
        for j in range(i + RIDER, riders * RIDER, RIDER):
            if leads(w, r[j], r[first], k, d):
                first = j
        for column in range(RIDER):
            value = r[i + column]
            r[i + column] = r[first + column]
            r[first + column] = value
        went = d if k == 2 and d > 0 else swept(w, 0, r[i], k, d)
        if went != 0:
            shift(w, r[i], r[i + 1], k, went, key, tick)


# -- the whole turn -------------------------------------------------------------------------------------------


@inlined
def turn(w: Arrays, row: int, key: int, tick: int) -> bool:
    """Makes the whole turn of one entity. Returns whether it stays awake."""
    e, p, t = w.entities, w.parameters, w.templates
    at = row << WIDTH_SHIFT
    near = w.near  # nearly all look-ups of this turn concern the segment that the entity is in
    near[0] = e[at + X] >> TO_SEGMENT
    near[1] = e[at + Y] >> TO_SEGMENT
    near[2] = e[at + Z] >> TO_SEGMENT
    near[3] = e[at + CELL] >> CELLS_SHIFT
    kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
    x0 = e[at + X] + t[kind + LO_X]
    y0 = e[at + Y] + t[kind + LO_X + 1]
    z0 = e[at + Z] + t[kind + LO_X + 2]
    x1 = x0 + t[kind + SIZE_X]
    y1 = y0 + t[kind + SIZE_X + 1]
    z1 = z0 + t[kind + SIZE_X + 2]
    vx = e[at + VX]
    vy = e[at + VY]
    vz = e[at + VZ]
    falling = e[at + FLAGS] & FALLING
    meets = p[PAIRS] != 0 and t[kind + SOLID] != 0
    walks = False
    jumps = False
    events = 0

    if t[kind + WALKS] != 0:
        east = e[at + MOVE_X]
        north = e[at + MOVE_Y]
        walks = east != 0 or north != 0
        walk = e[at + TEMPLATE] * MOVES + MOVE_MAX
        vx = w.walk[walk + east]
        vy = w.walk[walk + north]
    from_vz = vz
    if t[kind + WEIGHT] != 0:
        jumps = e[at + BUTTONS] & JUMP != 0 and t[kind + JUMP_SPEED] != 0
        if falling == 0 or jumps:
            if stands_on_block(w, x0, y0, x1, y1, z0) or (meets and stands_on_entity(w, row, x0, y0, x1, y1, z0)):
                if jumps:
                    vz = t[kind + JUMP_SPEED]
                    falling = FALLING
                    events = LAUNCH
            elif falling == 0:
                falling = FALLING
                events = FALL
        from_vz = vz
        if falling != 0:
            vz = max(vz - t[kind + WEIGHT], -p[TERMINAL])
        if p[MEAN] == 0:
            from_vz = vz
    if t[kind + TOP_SQUARE] != 0:
        if t[kind + WALKS] == 0:
            vx = 0
            vy = 0
        rate = pace(t, kind, falling, walks, e[at + VX], e[at + VY])
        away = length(vx - e[at + VX], vy - e[at + VY])
        vx = toward(e[at + VX], vx, rate, away)
        vy = toward(e[at + VY], vy, rate, away)
        if t[kind + WEIGHT] == 0:
            vz = toward(vz, 0, t[kind + GROUND + SLOW_DOWN], abs(vz))
            from_vz = vz

    moved = False
    dx = 0
    dy = 0
    went_x = 0
    went_y = 0
    if from_vz != 0 or vz != 0 or vx != 0 or vy != 0:
        dx = displacement(p, 2 * vx)
        dy = displacement(p, 2 * vy)
        dz = displacement(p, from_vz + vz)
        n = 0
        riders = 0
        up = dz
        if meets:
            if t[kind + CARRIES] != 0:
                riders = board(w, row, tick)
                if dz > 0:
                    up = lift(w, riders, dz)
            n = gather(
                w, row, True,
                x0 + min(dx, 0), y0 + min(dy, 0), z0 + min(dz, 0),
                x1 + max(dx, 0), y1 + max(dy, 0), z1 + max(dz, 0),
            )  # fmt: skip
            if riders > 1 and dz > 0:
                others(w, riders, n)
        went_z = 0
        if dz != 0:
            if up != 0:
                went_z = sweep(w, 2, up, n, z0, z1, x0, x1, y0, y1)
            if went_z != dz:
                vz = 0
                events |= STOP_Z
                if dz < 0:
                    falling = 0
        if dx != 0:
            went_x = sweep(w, 0, dx, n, x0, x1, y0, y1, z0 + went_z, z1 + went_z)
            if went_x != dx:
                vx = 0
        if dy != 0:
            went_y = sweep(w, 1, dy, n, y0, y1, z0 + went_z, z1 + went_z, x0 + went_x, x1 + went_x)
            if went_y != dy:
                vy = 0
        if went_x != 0 or went_y != 0 or went_z != 0:
            moved = True
            x = e[at + X]
            y = e[at + Y]
            z = e[at + Z]
            e[at + X] = x + went_x
            e[at + Y] = y + went_y
            e[at + Z] = z + went_z
            borders = x ^ x + went_x | y ^ y + went_y | z ^ z + went_z
            if borders >> TO_CELL != 0:
                relink(w, row)
                if borders >> TO_SEGMENT != 0:
                    events |= WHOLE
            if riders > 0:
                n = gather(w, row, True, x0, y0, z1, x1, y1, z1)
            if n > 0 and p[GRAVITY] != 0:
                wake_riders(w, n, x0, y0, x1, y1, z1, key)
            if riders > 1:
                if went_z != 0:
                    carry(w, riders, 2, went_z, key, tick)
                if went_x != 0:
                    carry(w, riders, 0, went_x, key, tick)
                if went_y != 0:
                    carry(w, riders, 1, went_y, key, tick)
            z0 += went_z

    before = e[at + CHANGED] if e[at + CHANGED] >> EVENT_BITS == tick else 0
    told = before & (TOLD | WHOLE) == TOLD
    if before & (STOP_X | STOP_Y | STOP_Z) != 0 and (vx != 0 or vy != 0 or vz != 0 or falling != 0):
        events |= WHOLE
    if went_x != dx:
        if told or went_x != 0 or e[at + VX] != 0:
            events |= STOP_X
    elif vx != e[at + VX] and not told and (t[kind + TOP_SQUARE] == 0 or e[at + VX] == 0):
        events |= GO_X
    if went_y != dy:
        if told or went_y != 0 or e[at + VY] != 0:
            events |= STOP_Y
    elif vy != e[at + VY] and not told and (t[kind + TOP_SQUARE] == 0 or e[at + VY] == 0):
        events |= GO_Y
    if moved or told or events != 0 or vz != e[at + VZ] or vx != e[at + VX] or vy != e[at + VY]:
        e[at + VX] = vx
        e[at + VY] = vy
        e[at + VZ] = vz
        e[at + FLAGS] = (e[at + FLAGS] & ~FALLING) | falling
        mark(w, row, tick, events)
    if z0 >> BLOCK_SHIFT < p[FLOOR]:
        w.fell[w.lengths[N_FELL]] = e[at + ID]
        w.lengths[N_FELL] += 1
    return moved or falling != 0 or vx != 0 or vy != 0 or vz != 0 or walks or jumps


@inlined
def mark(w: Arrays, row: int, tick: int, events: int) -> None:
    """Notes that an entity changed in this tick, or before its step, and the events that changed it."""
    if w.lengths[N_STEPPED] != 0:
        w.lengths[N_STEPPED] = 0
        w.lengths[N_CHANGED] = 0
    at = row << WIDTH_SHIFT
    if w.entities[at + CHANGED] >> EVENT_BITS != tick:
        w.entities[at + CHANGED] = tick << EVENT_BITS
        w.changed[w.lengths[N_CHANGED]] = row
        w.lengths[N_CHANGED] += 1
    w.entities[at + CHANGED] |= events


# -- the tick ------------------------------------------------------------------------------------------------


@jit
def step(w: Arrays, inputs: Any, n_inputs: int, tick: int) -> None:
    """Computes one tick. An entity without an input goes on with its latest one.

    Args:
        w: arrays of the world.
        inputs: [n_inputs * 4] row, move_x, move_y, buttons.
        n_inputs: number of inputs.
        tick: number of the tick.
    """
    e, n = w.entities, w.lengths
    if n[N_STEPPED] != 0:
        n[N_CHANGED] = 0
    n[N_STEPPED] = 0
    n[N_FELL] = 0
    for i in range(n_inputs):
        row = inputs[4 * i]
        wishes = (row << WIDTH_SHIFT) + MOVE_X
        for k in range(3):
            wish = inputs[4 * i + 1 + k]
            if k < 2:
                wish = min(max(wish, -MOVE_MAX), MOVE_MAX)
            if e[wishes + k] != wish:
                e[wishes + k] = wish
                mark(w, row, tick, TOLD | (NEW_MOVE if k < 2 else NEW_BUTTONS))
        wake(w, row, -1)

    at = 0
    kept = 0
    last = -1
    while at < n[N_AWAKE] or n[N_WOKEN] > 0:
        if n[N_WOKEN] > 0 and (at >= n[N_AWAKE] or w.woken[0] < w.awake[at]):
            key = pop(w.woken, n[N_WOKEN])
            n[N_WOKEN] -= 1
        else:
            key = w.awake[at]
            at += 1
        row = key & ROW_MASK
        if key == last or e[(row << WIDTH_SHIFT) + ID] != key >> ROW_BITS:
            continue  # the key occurs twice, or the entity was removed after it was woken
        last = key
        if turn(w, row, key, tick):
            w.next_awake[kept] = key
            kept += 1
        else:
            e[(row << WIDTH_SHIFT) + FLAGS] &= ~AWAKE
    for i in range(kept):
        w.awake[i] = w.next_awake[i]
    n[N_AWAKE] = kept
    for i in range(n[N_LATER]):
        push(w.woken, i, w.later[i])
    n[N_WOKEN] = n[N_LATER]
    n[N_LATER] = 0
    n[N_STEPPED] = 1


# -- rows written from outside -------------------------------------------------------------------------------


@jit
def leave(w: Arrays, row: int, states: Any, i: int) -> None:
    """Wakes the entities that stand on an entity, if the state at `i` moves it or changes its template."""
    e, t = w.entities, w.templates
    at = row << WIDTH_SHIFT
    same = e[at + TEMPLATE] == states[i + TEMPLATE]
    for k in range(X, X + 3):
        same = same and e[at + k] == states[i + k]
    if not same:
        kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
        x = e[at + X] + t[kind + LO_X]
        y = e[at + Y] + t[kind + LO_X + 1]
        top = e[at + Z] + t[kind + LO_X + 2] + t[kind + SIZE_X + 2]
        wake_on(w, row, x, y, x + t[kind + SIZE_X], y + t[kind + SIZE_X + 1], top)


@jit
def write(w: Arrays, row: int, states: Any, i: int, tick: int) -> None:
    """Writes the state at `i` to a row before the step of `tick`. Wakes the entity and those that stand on it."""
    e = w.entities
    at = row << WIDTH_SHIFT
    if e[at + CELL] >= 0:
        leave(w, row, states, i)
    awake = e[at + FLAGS] & AWAKE
    for k in range(CELL):
        e[at + k] = states[i + k]
    falls = FALLING if w.templates[e[at + TEMPLATE] * TEMPLATE_COLUMNS + WEIGHT] != 0 else 0
    e[at + FLAGS] = e[at + FLAGS] & falls | awake
    mark(w, row, tick, WHOLE)
    relink(w, row)
    wake(w, row, -1)


@jit
def store(w: Arrays, rows: Any, states: Any, n: int, tick: int) -> None:
    """Writes `n` states to their rows before the step of `tick`."""
    for i in range(n):
        write(w, rows[i], states, CELL * i, tick)


@jit
def settle(w: Arrays, rows: Any, states: Any, n: int, tick: int) -> int:
    """Writes the states of new entities like `store`, up to the first whose place is occupied.

    Returns the number of states written.
    """
    t, c = w.templates, w.candidates
    for i in range(n):
        kind = states[CELL * i + TEMPLATE] * TEMPLATE_COLUMNS
        x0 = states[CELL * i + X] + t[kind + LO_X]
        y0 = states[CELL * i + Y] + t[kind + LO_X + 1]
        z0 = states[CELL * i + Z] + t[kind + LO_X + 2]
        x1 = x0 + t[kind + SIZE_X]
        y1 = y0 + t[kind + SIZE_X + 1]
        z1 = z0 + t[kind + SIZE_X + 2]
        if blocks_in(w, x0, y0, z0, x1, y1, z1):
            return i
        if w.parameters[PAIRS] != 0 and t[kind + SOLID] != 0:
            for m in range(0, gather(w, -1, True, x0, y0, z0, x1, y1, z1), CANDIDATE):
                if c[m] < x1 and c[m + 3] > x0 and c[m + 1] < y1 and c[m + 4] > y0 and c[m + 2] < z1 and c[m + 5] > z0:
                    return i
        write(w, rows[i], states, CELL * i, tick)
    return n


# -- turns taken again ---------------------------------------------------------------------------------------


@inlined
def stopped_at(t: Any, kind: int, axis: int, place: int) -> int:
    """Returns the position within the segment that an explicit turn (`layout.TURN`) gives for an axis."""
    if place < 0:
        edge = -1 - place
        place = ((edge & IN_SEGMENT >> BLOCK_SHIFT) << BLOCK_SHIFT) - t[kind + LO_X + axis]
        if edge & EDGE_HIGH != 0:
            place -= t[kind + SIZE_X + axis]
    return place & IN_SEGMENT


@inlined
def advance(w: Arrays, row: int, events: int, turns: Any, i: int) -> None:
    """Makes the turn of an entity in a world that is written, not stepped: as `turn`, but with given events.

    Without events, the entity moves on as before, with nothing in its way. An entity that would leave its segment stays
    as it was, because the server then sends its whole state.

    Args:
        w: arrays of the world.
        row: row of the entity.
        events: events of the turn (`layout.STOP_X` ...).
        turns: explicit turns, [n * 8], with the input and the position of the events.
        i: place of this turn in `turns`.
    """
    e, p, t = w.entities, w.parameters, w.templates
    at = row << WIDTH_SHIFT
    kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
    vx = e[at + VX]
    vy = e[at + VY]
    vz = e[at + VZ]
    falling = e[at + FLAGS] & FALLING
    if events & TOLD != 0 and events & NEW_MOVE != 0:
        e[at + MOVE_X] = min(max(turns[i + 2], -MOVE_MAX), MOVE_MAX)
        e[at + MOVE_Y] = min(max(turns[i + 3], -MOVE_MAX), MOVE_MAX)
    if events & TOLD != 0 and events & NEW_BUTTONS != 0:
        e[at + BUTTONS] = turns[i + 4]
    if events & LAUNCH != 0:
        vz = t[kind + JUMP_SPEED]
    if events & (LAUNCH | FALL) != 0:
        falling = FALLING
    go_x = events & (TOLD | GO_X) != 0
    go_y = events & (TOLD | GO_Y) != 0
    walk = e[at + TEMPLATE] * MOVES + MOVE_MAX
    if t[kind + TOP_SQUARE] != 0:
        wish_x = 0
        wish_y = 0
        walks = False
        if t[kind + WALKS] != 0:
            walks = e[at + MOVE_X] != 0 or e[at + MOVE_Y] != 0
            wish_x = w.walk[walk + e[at + MOVE_X]]
            wish_y = w.walk[walk + e[at + MOVE_Y]]
        rate = pace(t, kind, falling, walks, vx, vy)
        away = length(wish_x - vx, wish_y - vy)
        if vx != 0 or go_x:  # without an event, an axis along which the entity rests is blocked
            vx = toward(vx, wish_x, rate, away)
        if vy != 0 or go_y:
            vy = toward(vy, wish_y, rate, away)
    elif t[kind + WALKS] != 0:
        if go_x:
            vx = w.walk[walk + e[at + MOVE_X]]
        if go_y:
            vy = w.walk[walk + e[at + MOVE_Y]]
    from_vz = vz
    if t[kind + WEIGHT] != 0:
        if falling != 0:
            vz = max(vz - t[kind + WEIGHT], -p[TERMINAL])
        if p[MEAN] == 0:
            from_vz = vz
    elif t[kind + TOP_SQUARE] != 0:
        vz = toward(vz, 0, t[kind + GROUND + SLOW_DOWN], abs(vz))
        from_vz = vz
    x = e[at + X]
    y = e[at + Y]
    z = e[at + Z]
    if events & STOP_X != 0:
        to_x = x & ~IN_SEGMENT | stopped_at(t, kind, 0, turns[i + 5])
        vx = 0
    else:
        to_x = x + displacement(p, 2 * vx)
    if events & STOP_Y != 0:
        to_y = y & ~IN_SEGMENT | stopped_at(t, kind, 1, turns[i + 6])
        vy = 0
    else:
        to_y = y + displacement(p, 2 * vy)
    if events & STOP_Z != 0:
        to_z = z & ~IN_SEGMENT | stopped_at(t, kind, 2, turns[i + 7])
        if from_vz + vz < 0:
            falling = 0
        vz = 0
    else:
        to_z = z + displacement(p, from_vz + vz)
    borders = x ^ to_x | y ^ to_y | z ^ to_z
    if borders >> TO_SEGMENT != 0:
        return
    e[at + X] = to_x
    e[at + Y] = to_y
    e[at + Z] = to_z
    e[at + VX] = vx
    e[at + VY] = vy
    e[at + VZ] = vz
    e[at + FLAGS] = (e[at + FLAGS] & ~FALLING) | falling
    if borders >> TO_CELL != 0:
        relink(w, row)


@jit
def follow(w: Arrays, turns: Any, n: int, rows: int, ticks: int, tick: int) -> bool:
    """Extrapolates the first `rows` rows by `ticks`, and applies `n` explicit turns for one tick.

    A row with an explicit turn is not extrapolated, nor is one that was written before `tick`. Afterwards no row counts
    as changed.

    Args:
        w: arrays of the world.
        turns: explicit turns, [n * 8]: row (-1: there is no such entity), events, input (3), position (3).
        n: number of explicit turns.
        rows: number of rows of the world.
        ticks: number of ticks.
        tick: number of the first of these ticks.

    Returns:
        Whether there is an entity for every explicit turn.
    """
    e = w.entities
    all_there = True
    for i in range(0, n * TURN, TURN):
        row = turns[i]
        if row < 0:
            all_there = False
        else:
            e[(row << WIDTH_SHIFT) + CHANGED] = tick << EVENT_BITS
            advance(w, row, turns[i + 1], turns, i)
    for row in range(rows):
        at = row << WIDTH_SHIFT
        moves = e[at + VX] != 0 or e[at + VY] != 0 or e[at + VZ] != 0 or e[at + FLAGS] & FALLING != 0
        if moves and e[at + ID] != 0 and e[at + CHANGED] >> EVENT_BITS != tick:
            for _ in range(ticks):
                advance(w, row, 0, turns, 0)
        e[at + CHANGED] = -1
    w.lengths[N_CHANGED] = 0
    w.lengths[N_FELL] = 0
    return all_there


# -- reading -------------------------------------------------------------------------------------------------


@jit
def collect(e: Any, rows: int, out: Any) -> int:
    """Copies the states of all entities to `out` ([rows * 12]), ascending by id, without the bookkeeping flag.

    Returns the number of states.
    """
    n = 0
    for row in range(rows):
        from_ = row << WIDTH_SHIFT
        entity = e[from_ + ID]
        if entity == 0:
            continue
        at = CELL * n
        while at > 0 and out[at - CELL + ID] > entity:
            for k in range(CELL):
                out[at + k] = out[at - CELL + k]
            at -= CELL
        for k in range(CELL):
            out[at + k] = e[from_ + k]
        out[at + FLAGS] &= FALLING
        n += 1
    return n
