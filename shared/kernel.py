"""The only code that moves anything.

Theory of operation. `step` gives every awake entity its turn, in ascending order of id; a turn is

    supported?  ->  input  ->  gravity  ->  move z, x, y, each up to the first obstacle  ->  awake still?

Nobody else is looked at: what could start to move is woken by the event that lets it (`wake`), and an entity
woken by one of a lower id has its turn in the same tick, exactly as if it had been awake all along. So sleep
is invisible in the results, and a sleeper costs nothing.

A move is swept: along one axis, the leading face passes the layers of cells and the faces of solid entities
that it newly reaches, and stops *on* the first one. The numbers are whole grid steps, so "on" is equality; a
box that overlapped nothing overlaps nothing afterwards, at any speed, with no epsilon and no second pass. What
was overlapped at the start is no obstacle: it can be left. Rejected: the rewind along the whole velocity
(loses 93 % of the motion along a wall) and merged slabs (6 times slower than the dense look-up, and their
seams catch a sliding box).

This source runs compiled by Numba and, unchanged, without it (`shared.kernels`): whole numbers, loops and
comparisons only.
"""

from typing import TYPE_CHECKING, Any, TypeVar

from shared.inputs import JUMP, MOVE_MAX
from shared.layout import (
    AWAKE,
    BUTTONS,
    CELL,
    CELL_SHIFT,
    CELLS,
    CHANGED,
    EXACT,
    FALLING,
    FLAGS,
    FLOOR,
    GRAVITY,
    ID,
    JUMP_SPEED,
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
    NEXT,
    NOWHERE,
    PAIRS,
    PREV,
    RATE,
    REACH_HI,
    REACH_LO,
    SIZE_X,
    SOLID,
    TEMPLATE,
    TERMINAL,
    VX,
    VY,
    VZ,
    WALKS,
    Arrays,
    X,
    Y,
    Z,
)  # fmt: skip
from shared.units import BLOCK, BLOCK_SHIFT, SEGMENT_SHIFT

F = TypeVar("F")

COMPILED = __name__.endswith("_compiled")
"""Whether this is the compiled instance of the module."""

if TYPE_CHECKING or not COMPILED:

    def jit(function: F) -> F:
        return function

    inlined = jit
else:
    from numba import njit

    # Without reference counts on the arrays a turn takes 60 ns instead of 2,200: nothing here allocates any.
    jit = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
    inlined = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, forceinline=True)

ROW_BITS = 32
ROW_MASK = (1 << ROW_BITS) - 1
INSIDE = (1 << SEGMENT_SHIFT) - 1


# -- looking things up ---------------------------------------------------------------------------------------


@inlined
def segment_row(w: Arrays, x: int, y: int, z: int) -> int:
    """The row of a loaded segment, or -1; the latest answer is kept in `near`."""
    near = w.near
    if near[0] == x and near[1] == y and near[2] == z:
        return near[3]
    return find_segment(w.table, w.segments, near, x, y, z)


@jit
def find_segment(table: Any, segments: Any, near: Any, x: int, y: int, z: int) -> int:
    """The same through the hash table."""
    mask = len(table) - 1
    at = (x * 73856093 ^ y * 19349663 ^ z * 83492791) & mask
    row = -1
    while table[at] != 0:
        found = table[at] - 1
        if segments[found, 0] == x and segments[found, 1] == y and segments[found, 2] == z:
            row = found
            break
        at = (at + 1) & mask
    near[0] = x
    near[1] = y
    near[2] = z
    near[3] = row
    return row


@inlined
def solid_at(w: Arrays, x: int, y: int, z: int) -> bool:
    """Whether this block stops things: what is not loaded does, the void below the floor does not."""
    row = segment_row(w, x >> SEGMENT_SHIFT, y >> SEGMENT_SHIFT, z >> SEGMENT_SHIFT)
    if row < 0:
        return z >= w.parameters[FLOOR]
    return w.blocks[row, (z & INSIDE) << 10 | (y & INSIDE) << 5 | (x & INSIDE)] != 0


@jit
def blocks_in(w: Arrays, x0: int, y0: int, z0: int, x1: int, y1: int, z1: int) -> bool:
    """Whether a solid block overlaps the open box between two corners."""
    for z in range(z0 >> BLOCK_SHIFT, ((z1 - 1) >> BLOCK_SHIFT) + 1):
        for y in range(y0 >> BLOCK_SHIFT, ((y1 - 1) >> BLOCK_SHIFT) + 1):
            for x in range(x0 >> BLOCK_SHIFT, ((x1 - 1) >> BLOCK_SHIFT) + 1):
                if solid_at(w, x, y, z):
                    return True
    return False


@jit
def gather(w: Arrays, but: int, solid: bool, x0: int, y0: int, z0: int, x1: int, y1: int, z1: int) -> int:
    """Fills `candidates` with the (solid) entities that overlap or touch a box, row `but` left out; how many."""
    p, e, t, found = w.parameters, w.entities, w.templates, w.candidates
    shift = BLOCK_SHIFT + CELL_SHIFT
    n = 0
    for cz in range((z0 - p[REACH_HI + 2]) >> shift, ((z1 + p[REACH_LO + 2]) >> shift) + 1):
        for cy in range((y0 - p[REACH_HI + 1]) >> shift, ((y1 + p[REACH_LO + 1]) >> shift) + 1):
            for cx in range((x0 - p[REACH_HI]) >> shift, ((x1 + p[REACH_LO]) >> shift) + 1):
                segment = max(segment_row(w, cx >> 3, cy >> 3, cz >> 3), NOWHERE)
                row = w.heads[segment * CELLS + ((cz & 7) << 6 | (cy & 7) << 3 | (cx & 7))]
                while row >= 0:
                    kind = e[row, TEMPLATE]
                    here = segment != NOWHERE or (
                        e[row, X] >> shift == cx and e[row, Y] >> shift == cy and e[row, Z] >> shift == cz
                    )
                    if here and row != but and (not solid or t[kind, SOLID] != 0):
                        x = e[row, X] + t[kind, LO_X]
                        y = e[row, Y] + t[kind, LO_X + 1]
                        z = e[row, Z] + t[kind, LO_X + 2]
                        hx = x + t[kind, SIZE_X]
                        hy = y + t[kind, SIZE_X + 1]
                        hz = z + t[kind, SIZE_X + 2]
                        if x <= x1 and hx >= x0 and y <= y1 and hy >= y0 and z <= z1 and hz >= z0:
                            found[n, 0] = x
                            found[n, 1] = y
                            found[n, 2] = z
                            found[n, 3] = hx
                            found[n, 4] = hy
                            found[n, 5] = hz
                            found[n, 6] = row
                            n += 1
                    row = e[row, NEXT]
    return n


# -- the index of cells --------------------------------------------------------------------------------------


@inlined
def cell_of(w: Arrays, row: int) -> int:
    e = w.entities
    x = e[row, X] >> (BLOCK_SHIFT + CELL_SHIFT)
    y = e[row, Y] >> (BLOCK_SHIFT + CELL_SHIFT)
    z = e[row, Z] >> (BLOCK_SHIFT + CELL_SHIFT)
    segment = max(segment_row(w, x >> 3, y >> 3, z >> 3), NOWHERE)
    return segment * CELLS + ((z & 7) << 6 | (y & 7) << 3 | (x & 7))


@jit
def unlink(w: Arrays, row: int) -> None:
    e = w.entities
    cell = e[row, CELL]
    if cell < 0:
        return
    before = e[row, PREV]
    after = e[row, NEXT]
    if before >= 0:
        e[before, NEXT] = after
    else:
        w.heads[cell] = after
    if after >= 0:
        e[after, PREV] = before
    e[row, CELL] = -1
    if cell < CELLS:
        w.lengths[N_HOMELESS] -= 1


@jit
def relink(w: Arrays, row: int) -> None:
    """Puts an entity into the cell of its position, if it is not there."""
    cell = cell_of(w, row)
    e = w.entities
    if cell == e[row, CELL]:
        return
    unlink(w, row)
    first = w.heads[cell]
    e[row, CELL] = cell
    e[row, PREV] = -1
    e[row, NEXT] = first
    if first >= 0:
        e[first, PREV] = row
    w.heads[cell] = row
    if cell < CELLS:
        w.lengths[N_HOMELESS] += 1


@jit
def relink_range(w: Arrays, start: int, stop: int) -> None:
    for row in range(start, stop):
        if w.entities[row, ID] != 0:
            relink(w, row)


# -- waking --------------------------------------------------------------------------------------------------


@jit
def push(heap: Any, n: int, key: int) -> None:
    """Adds `key` to a heap of `n` keys, the least on top."""
    while n > 0:
        parent = (n - 1) >> 1
        if heap[parent] <= key:
            break
        heap[n] = heap[parent]
        n = parent
    heap[n] = key


@jit
def pop(heap: Any, n: int) -> int:
    """Takes the least of a heap of `n` keys."""
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


@jit
def wake(w: Arrays, row: int, turn: int) -> None:
    """Gives a sleeper its next turn: in this tick if it comes after key `turn`, else in the next."""
    e, n = w.entities, w.lengths
    if e[row, FLAGS] & AWAKE:
        return
    e[row, FLAGS] |= AWAKE
    key = e[row, ID] << ROW_BITS | row
    if key > turn:
        push(w.woken, n[N_WOKEN], key)
        n[N_WOKEN] += 1
    else:
        w.later[n[N_LATER]] = key
        n[N_LATER] += 1


@jit
def wake_riders(w: Arrays, n: int, x0: int, y0: int, x1: int, y1: int, top: int, turn: int) -> None:
    """Wakes those of `n` candidates that stand on the face between (x0, y0) and (x1, y1) at height `top`."""
    c = w.candidates
    for i in range(n):
        if c[i, 2] == top and c[i, 0] < x1 and c[i, 3] > x0 and c[i, 1] < y1 and c[i, 4] > y0:
            wake(w, c[i, 6], turn)


@jit
def wake_on(w: Arrays, but: int, x0: int, y0: int, x1: int, y1: int, top: int) -> None:
    """Wakes whatever stands on a face: it is about to go (`but`: the row of its owner, or -1)."""
    wake_riders(w, gather(w, but, False, x0, y0, top, x1, y1, top), x0, y0, x1, y1, top, -1)


@jit
def wake_in(w: Arrays, x0: int, y0: int, z0: int, x1: int, y1: int, z1: int) -> None:
    """Wakes whatever overlaps or touches a box."""
    for i in range(gather(w, -1, False, x0, y0, z0, x1, y1, z1)):
        wake(w, w.candidates[i, 6], -1)


# -- the turn of one entity ----------------------------------------------------------------------------------


@inlined
def displacement(p: Any, velocity_sum: int) -> int:
    """Grid steps in one tick for the sum of the old and the new velocity, rounded halves away from zero."""
    if p[EXACT] != 0:
        return velocity_sum * p[EXACT]
    rate = p[RATE]
    if velocity_sum >= 0:
        return (velocity_sum * 256 + rate) // (2 * rate)
    return -((rate - velocity_sum * 256) // (2 * rate))


@inlined
def stands_on_block(w: Arrays) -> bool:
    """Whether a solid block touches the underside of the box, with an area."""
    b = w.box
    if b[2] & (BLOCK - 1) != 0:
        return False
    z = (b[2] >> BLOCK_SHIFT) - 1
    for y in range(b[1] >> BLOCK_SHIFT, ((b[4] - 1) >> BLOCK_SHIFT) + 1):
        for x in range(b[0] >> BLOCK_SHIFT, ((b[3] - 1) >> BLOCK_SHIFT) + 1):
            if solid_at(w, x, y, z):
                return True
    return False


@inlined
def stands_on_entity(w: Arrays, row: int) -> bool:
    """Whether a solid entity does."""
    b, c = w.box, w.candidates
    for i in range(gather(w, row, True, b[0], b[1], b[2], b[3], b[4], b[2])):
        if c[i, 5] == b[2] and c[i, 0] < b[3] and c[i, 3] > b[0] and c[i, 1] < b[4] and c[i, 4] > b[1]:
            return True
    return False


@inlined
def layer_solid(w: Arrays, k: int, layer: int, i0: int, i1: int, j0: int, j1: int) -> bool:
    """Whether a solid block lies in a layer across axis k, rows i along axis k+1 and j along axis k+2."""
    for i in range(i0, i1):
        for j in range(j0, j1):
            if k == 0:
                hit = solid_at(w, layer, i, j)
            elif k == 1:
                hit = solid_at(w, j, layer, i)
            else:
                hit = solid_at(w, i, j, layer)
            if hit:
                return True
    return False


@inlined
def sweep(w: Arrays, k: int, d: int, n: int) -> int:
    """How far the box gets along axis k, wishing for d != 0, with `n` candidates; moves it."""
    b, c = w.box, w.candidates
    i = (k + 1) % 3
    j = (k + 2) % 3
    i0 = b[i] >> BLOCK_SHIFT
    i1 = ((b[i + 3] - 1) >> BLOCK_SHIFT) + 1
    j0 = b[j] >> BLOCK_SHIFT
    j1 = ((b[j + 3] - 1) >> BLOCK_SHIFT) + 1
    if d > 0:
        face = b[k + 3]
        to = face + d
        for layer in range((face + BLOCK - 1) >> BLOCK_SHIFT, (to + BLOCK - 1) >> BLOCK_SHIFT):
            if layer_solid(w, k, layer, i0, i1, j0, j1):
                to = layer << BLOCK_SHIFT
                break
        for m in range(n):
            if c[m, k] >= face and c[m, k] < to:  # noqa: SIM102
                if c[m, i] < b[i + 3] and c[m, i + 3] > b[i] and c[m, j] < b[j + 3] and c[m, j + 3] > b[j]:
                    to = c[m, k]
    else:
        face = b[k]
        to = face + d
        for layer in range((face >> BLOCK_SHIFT) - 1, (to >> BLOCK_SHIFT) - 1, -1):
            if layer_solid(w, k, layer, i0, i1, j0, j1):
                to = (layer + 1) << BLOCK_SHIFT
                break
        for m in range(n):
            if c[m, k + 3] <= face and c[m, k + 3] > to:  # noqa: SIM102
                if c[m, i] < b[i + 3] and c[m, i + 3] > b[i] and c[m, j] < b[j + 3] and c[m, j + 3] > b[j]:
                    to = c[m, k + 3]
    b[k] += to - face
    b[k + 3] += to - face
    return to - face


@inlined
def turn(w: Arrays, row: int, key: int, tick: int) -> bool:
    """The whole turn of one entity; whether it stays awake."""
    e, p, b = w.entities, w.parameters, w.box
    t = w.templates
    kind = e[row, TEMPLATE]
    flags = e[row, FLAGS]
    vx = e[row, VX]
    vy = e[row, VY]
    vz = e[row, VZ]
    for k in range(3):
        b[k] = e[row, X + k] + t[kind, LO_X + k]
        b[k + 3] = b[k] + t[kind, SIZE_X + k]
    meets = p[PAIRS] != 0 and t[kind, SOLID] != 0
    falling = flags & FALLING
    jumps = p[GRAVITY] != 0 and e[row, BUTTONS] & JUMP != 0 and t[kind, JUMP_SPEED] != 0

    if t[kind, WALKS] != 0:
        vx = w.walk[kind, e[row, MOVE_X] + 127]
        vy = w.walk[kind, e[row, MOVE_Y] + 127]
    from_vz = vz
    if p[GRAVITY] != 0:
        if falling == 0 or jumps:
            if stands_on_block(w) or (meets and stands_on_entity(w, row)):
                if jumps:
                    vz = t[kind, JUMP_SPEED]
                    falling = FALLING
            else:
                falling = FALLING
        from_vz = vz
        if falling != 0:
            vz -= p[GRAVITY]
            if vz < -p[TERMINAL]:
                vz = -p[TERMINAL]
        if p[MEAN] == 0:
            from_vz = vz

    moved = False
    if from_vz != 0 or vz != 0 or vx != 0 or vy != 0:
        dx = displacement(p, 2 * vx)
        dy = displacement(p, 2 * vy)
        dz = displacement(p, from_vz + vz)
        x0 = b[0]
        y0 = b[1]
        x1 = b[3]
        y1 = b[4]
        top = b[5]
        n = 0
        if meets:
            n = gather(
                w, row, True,
                x0 + min(dx, 0), y0 + min(dy, 0), b[2] + min(dz, 0),
                x1 + max(dx, 0), y1 + max(dy, 0), top + max(dz, 0),
            )  # fmt: skip
        if dz != 0:
            went = sweep(w, 2, dz, n)
            if went != dz:
                vz = 0
                if dz < 0:
                    falling = 0
            moved = went != 0
        if dx != 0:
            went = sweep(w, 0, dx, n)
            if went != dx:
                vx = 0
            moved = moved or went != 0
        if dy != 0:
            went = sweep(w, 1, dy, n)
            if went != dy:
                vy = 0
            moved = moved or went != 0
        if moved:
            for k in range(3):
                e[row, X + k] = b[k] - t[kind, LO_X + k]
            relink(w, row)
            if n > 0 and p[GRAVITY] != 0:
                wake_riders(w, n, x0, y0, x1, y1, top, key)

    if moved or vx != e[row, VX] or vy != e[row, VY] or vz != e[row, VZ] or falling != flags & FALLING:
        e[row, VX] = vx
        e[row, VY] = vy
        e[row, VZ] = vz
        e[row, FLAGS] = (e[row, FLAGS] & ~FALLING) | falling
        mark(w, row, tick)
    if b[2] >> BLOCK_SHIFT < p[FLOOR]:
        w.fell[w.lengths[N_FELL]] = e[row, ID]
        w.lengths[N_FELL] += 1
    walks = t[kind, WALKS] != 0 and (e[row, MOVE_X] != 0 or e[row, MOVE_Y] != 0)
    return moved or falling != 0 or vx != 0 or vy != 0 or vz != 0 or walks or jumps


@inlined
def mark(w: Arrays, row: int, tick: int) -> None:
    """Notes that the state of an entity changed in this tick, or before its step."""
    if w.lengths[N_STEPPED] != 0:
        w.lengths[N_STEPPED] = 0
        w.lengths[N_CHANGED] = 0
    if w.entities[row, CHANGED] != tick:
        w.entities[row, CHANGED] = tick
        w.changed[w.lengths[N_CHANGED]] = row
        w.lengths[N_CHANGED] += 1


# -- the tick ------------------------------------------------------------------------------------------------


@jit
def step(w: Arrays, inputs: Any, n_inputs: int, tick: int) -> None:
    """One tick. `inputs`: [n, 4] row, move_x, move_y, buttons; an entity without one keeps its latest."""
    e, n = w.entities, w.lengths
    if n[N_STEPPED] != 0:
        n[N_CHANGED] = 0
    n[N_STEPPED] = 0
    n[N_FELL] = 0
    for i in range(n_inputs):
        row = inputs[i, 0]
        for k in range(3):
            wish = inputs[i, 1 + k]
            if k < 2:
                wish = min(max(wish, -MOVE_MAX), MOVE_MAX)
            if e[row, MOVE_X + k] != wish:
                e[row, MOVE_X + k] = wish
                mark(w, row, tick)
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
        if key == last or e[row, ID] != key >> ROW_BITS:
            continue  # gone since it was woken
        last = key
        if turn(w, row, key, tick):
            w.next_awake[kept] = key
            kept += 1
        else:
            e[row, FLAGS] &= ~AWAKE
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
    """Wakes what stands on an entity that state `i` moves or changes."""
    e, t = w.entities, w.templates
    kind = e[row, TEMPLATE]
    same = kind == states[i, TEMPLATE]
    for k in range(X, X + 3):
        same = same and e[row, k] == states[i, k]
    if not same:
        x = e[row, X] + t[kind, LO_X]
        y = e[row, Y] + t[kind, LO_X + 1]
        top = e[row, Z] + t[kind, LO_X + 2] + t[kind, SIZE_X + 2]
        wake_on(w, row, x, y, x + t[kind, SIZE_X], y + t[kind, SIZE_X + 1], top)


@jit
def store(w: Arrays, rows: Any, states: Any, n: int, tick: int) -> None:
    """Writes `n` whole states ([n, 12], the state columns) into rows ahead of `tick`, wakes them and their riders."""
    e = w.entities
    for i in range(n):
        row = rows[i]
        if e[row, CELL] >= 0:
            leave(w, row, states, i)
        awake = e[row, FLAGS] & AWAKE
        for k in range(CELL):
            e[row, k] = states[i, k]
        e[row, FLAGS] = e[row, FLAGS] & FALLING | awake
        mark(w, row, tick)
        relink(w, row)
        wake(w, row, -1)
