"""Variants of the step: other number formats, integrators, movers and obstacles, selected by switches.

The product uses none of this. It exists so that the product's choices can be measured against their alternatives. Each
entity meets only blocks. Numbers are floats of either width; a grid is floats that hold only whole steps. Loaded a
second time as `variants_fast`, this source is compiled with fastmath, and stands for a machine whose compiler
contracts and reorders operations. The two builds differ in nothing else.
"""

import math
from typing import Any

from numba import njit

FAST = __name__.endswith("_fast")
# `_nrt` is off: no reference counts on the arrays, as in the product's kernel.
_options: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": FAST, "_nrt": False}
_njit = njit(**_options)


def jit(function: Any) -> Any:
    """Compiles a function under a name that depends on the build: Numba's cache knows only the name and the file."""
    function.__qualname__ += "_fast" if FAST else ""
    return _njit(function)


SEMI, EXPLICIT, MEAN = range(3)
CLAMP, REWIND, IMPACT = range(3)
CELLS, SLABS = range(2)

# Indices of the numbers (all of the format's width) and of the switches.
GRAVITY, TERMINAL, JUMP, STEP, HALF, SCALE, LO, SIZE = 0, 1, 2, 3, 4, 5, 6, 9
NUMBERS = 12
INTEGRATOR, MOVER, OBSTACLES = range(3)


@jit
def on_grid(d: Any, f: Any) -> Any:
    """Returns a displacement rounded to whole steps of the grid, halves away from zero; unchanged without a grid."""
    if f[SCALE] == 0:
        return d
    steps = math.floor(abs(d) * f[SCALE] + f[HALF])
    return steps / f[SCALE] if d >= 0 else -steps / f[SCALE]


@jit
def solid_in(t: Any, slabs: bool, x0: int, y0: int, z0: int, x1: int, y1: int, z1: int) -> bool:
    """Returns whether a block from one cell to the other (inclusive) is solid. Everything outside the map is solid."""
    kinds, rectangles, starts, origin = t
    nz, ny, nx = kinds.shape
    x0, x1, y0, y1, z0, z1 = (
        x0 - origin[0],
        x1 - origin[0],
        y0 - origin[1],
        y1 - origin[1],
        z0 - origin[2],
        z1 - origin[2],
    )
    if x0 < 0 or y0 < 0 or z0 < 0 or x1 >= nx or y1 >= ny or z1 >= nz:
        return True
    for z in range(z0, z1 + 1):
        if slabs:
            for sy in range(y0 >> 5, (y1 >> 5) + 1):
                for sx in range(x0 >> 5, (x1 >> 5) + 1):
                    at = (sy * (nx >> 5) + sx) * nz + z
                    for s in range(starts[at], starts[at + 1]):
                        r = rectangles[s]
                        if r[0] <= x1 and r[2] > x0 and r[1] <= y1 and r[3] > y0:
                            return True
        else:
            for y in range(y0, y1 + 1):
                for x in range(x0, x1 + 1):
                    if kinds[z, y, x] != 0:
                        return True
    return False


@jit
def across(t: Any, slabs: bool, k: int, layer: int, lo: Any, hi: Any) -> bool:
    """Returns whether a layer of cells across axis `k` is solid within the cross-section of a box."""
    a = (k + 1) % 3
    b = (k + 2) % 3
    a0, a1 = math.floor(lo[a]), math.ceil(hi[a]) - 1
    b0, b1 = math.floor(lo[b]), math.ceil(hi[b]) - 1
    hit: bool
    if k == 0:
        hit = solid_in(t, slabs, layer, a0, b0, layer, a1, b1)
    elif k == 1:
        hit = solid_in(t, slabs, b0, layer, a0, b1, layer, a1)
    else:
        hit = solid_in(t, slabs, a0, b0, layer, a1, b1, layer)
    return hit


@jit
def corners(p: Any, f: Any, lo: Any, hi: Any) -> None:
    for k in range(3):
        lo[k] = p[k] + f[LO + k]
        hi[k] = lo[k] + f[SIZE + k]


@jit
def put_on(p: Any, f: Any, k: int, face: int, d: Any) -> None:
    """Moves a box along axis `k` until its leading side is on a face."""
    side = p.dtype.type(face)
    if d > 0:
        p[k] = side - f[SIZE + k] - f[LO + k]
    else:
        p[k] = side - f[LO + k]


@jit
def clamp(t: Any, slabs: bool, p: Any, d: Any, f: Any, hit: Any, lo: Any, hi: Any) -> None:
    """The product's mover: moves along z, x and y in turn, each up to the first face."""
    for turn in range(3):
        k = (turn + 2) % 3
        if d[k] == 0:
            continue
        corners(p, f, lo, hi)
        if d[k] > 0:
            first, last, sign = math.ceil(hi[k]), math.ceil(hi[k] + d[k]) - 1, 1
        else:
            first, last, sign = math.floor(lo[k]) - 1, math.floor(lo[k] + d[k]), -1
        layer = first
        while (last - layer) * sign >= 0:
            if across(t, slabs, k, layer, lo, hi):
                put_on(p, f, k, layer if sign > 0 else layer + 1, d[k])
                hit[k] = True
                break
            layer += sign
        if not hit[k]:
            p[k] += d[k]


@jit
def rewind(t: Any, slabs: bool, p: Any, d: Any, f: Any, hit: Any, lo: Any, hi: Any) -> None:
    """The seed's mover: moves at once, then goes back along the velocity as long as the box overlaps a block."""
    for k in range(3):
        p[k] += d[k]
    for _ in range(4):
        corners(p, f, lo, hi)
        least = f[SCALE] * 0 + 2
        axis = -1
        face = 0
        for z in range(math.floor(lo[2]), math.ceil(hi[2])):
            for y in range(math.floor(lo[1]), math.ceil(hi[1])):
                for x in range(math.floor(lo[0]), math.ceil(hi[0])):
                    if not solid_in(t, slabs, x, y, z, x, y, z):
                        continue
                    for k in range(3):
                        cell = x if k == 0 else y if k == 1 else z
                        if d[k] > 0:
                            back = (hi[k] - cell) / d[k]
                        elif d[k] < 0:
                            back = (lo[k] - (cell + 1)) / d[k]
                        else:
                            continue
                        if back < least:
                            least = back
                            axis = k
                            face = cell if d[k] > 0 else cell + 1
        if axis < 0 or least > 1:
            return
        for k in range(3):
            if k == axis:
                put_on(p, f, k, face, d[k])
                hit[k] = True
            else:
                p[k] -= on_grid(least * d[k], f)


@jit
def soonest(t: Any, slabs: bool, left: Any, f: Any, lo: Any, hi: Any, edges: bool, scratch: Any) -> Any:
    """Returns the first impact of a motion: its time (2: none), axis and face.

    With `edges`, faces that the box reaches along the other axes at that very moment count, too; without it, they do
    not. If they never counted, a box could slip into a block whose edge it meets head-on. If they always did, walls
    would stop a box that slides along them.
    """
    low, high = scratch[0], scratch[1]
    best = f[SCALE] * 0 + 2
    axis = -1
    face = 0
    for turn in range(3):
        k = (turn + 2) % 3
        if left[k] == 0:
            continue
        sign = 1 if left[k] > 0 else -1
        layer = math.ceil(hi[k]) if sign > 0 else math.floor(lo[k]) - 1
        last = math.ceil(hi[k] + left[k]) - 1 if sign > 0 else math.floor(lo[k] + left[k])
        while (last - layer) * sign >= 0:
            side = layer if sign > 0 else layer + 1
            time = (side - (hi[k] if sign > 0 else lo[k])) / left[k]
            if time >= best:
                break
            for j in range(3):
                low[j] = lo[j] + time * left[j]
                high[j] = hi[j] + time * left[j]
                if edges or time > 0:
                    if left[j] > 0 and high[j] == math.floor(high[j]):
                        high[j] += f[HALF]
                    elif left[j] < 0 and low[j] == math.floor(low[j]):
                        low[j] -= f[HALF]
            if across(t, slabs, k, layer, low, high):
                best = time
                axis = k
                face = side
                break
            layer += sign
    return best, axis, face


@jit
def impact(t: Any, slabs: bool, p: Any, d: Any, f: Any, hit: Any, lo: Any, hi: Any, scratch: Any) -> None:
    """A sweeping mover: moves to the first impact, then continues with the rest of the motion along the other axes."""
    left = scratch[2]
    for k in range(3):
        left[k] = d[k]
    for _ in range(4):
        corners(p, f, lo, hi)
        time, axis, face = soonest(t, slabs, left, f, lo, hi, False, scratch)
        aligned = 0
        for k in range(3):
            lead = hi[k] if left[k] > 0 else lo[k]
            aligned += left[k] != 0 and lead == math.floor(lead)
        if aligned > 1 and time > 0:
            time, axis, face = soonest(t, slabs, left, f, lo, hi, True, scratch)
        if axis < 0:
            for k in range(3):
                p[k] += left[k]
            return
        for k in range(3):
            if k == axis:
                put_on(p, f, k, face, left[k])
                hit[k] = True
                left[k] = 0
            else:
                gone = on_grid(time * left[k], f)
                p[k] += gone
                left[k] -= gone


@jit
def step(
    t: Any,
    f: Any,
    switches: Any,
    places: Any,
    speeds: Any,
    falling: Any,
    wishes: Any,
    jumps: Any,
    hit: Any,
    scratch: Any,
) -> None:
    """Steps all entities. `wishes` is [n, 2] in blocks/s; `places`, `speeds` [n, 3]; `hit` [3]; `scratch` [6, 3]."""
    slabs = switches[OBSTACLES] == SLABS
    d, lo, hi = scratch[3], scratch[4], scratch[5]
    for i in range(len(places)):
        p = places[i]
        v = speeds[i]
        v[0] = wishes[i, 0]
        v[1] = wishes[i, 1]
        corners(p, f, lo, hi)
        if not falling[i] or jumps[i]:
            below = math.floor(lo[2])
            if lo[2] == below and across(t, slabs, 2, below - 1, lo, hi):
                if jumps[i]:
                    v[2] = f[JUMP]
                    falling[i] = True
            else:
                falling[i] = True
        before = v[2]
        if falling[i]:
            v[2] = max(v[2] - f[GRAVITY], -f[TERMINAL])
        if switches[INTEGRATOR] == SEMI:
            rise = v[2] * f[STEP]
        elif switches[INTEGRATOR] == EXPLICIT:
            rise = before * f[STEP]
        else:
            rise = (before + v[2]) * f[HALF] * f[STEP]
        d[0] = on_grid(v[0] * f[STEP], f)
        d[1] = on_grid(v[1] * f[STEP], f)
        d[2] = on_grid(rise, f)
        if d[0] == 0 and d[1] == 0 and d[2] == 0:
            continue
        for k in range(3):
            hit[k] = False
        if switches[MOVER] == CLAMP:
            clamp(t, slabs, p, d, f, hit, lo, hi)
        elif switches[MOVER] == REWIND:
            rewind(t, slabs, p, d, f, hit, lo, hi)
        else:
            impact(t, slabs, p, d, f, hit, lo, hi, scratch)
        for k in range(3):
            if hit[k]:
                v[k] = 0
        if hit[2] and d[2] < 0:
            falling[i] = False


@jit
def depths(t: Any, lows: Any, highs: Any, out: Any) -> None:
    """Writes to `out` how deep each box is inside a block, in blocks: 0 if it only touches one."""
    for i in range(len(lows)):
        deepest = 0.0
        lo, hi = lows[i], highs[i]
        for z in range(math.floor(lo[2]), math.ceil(hi[2])):
            for y in range(math.floor(lo[1]), math.ceil(hi[1])):
                for x in range(math.floor(lo[0]), math.ceil(hi[0])):
                    if solid_in(t, False, x, y, z, x, y, z):
                        deep = min(
                            min(hi[0] - x, x + 1 - lo[0]), min(hi[1] - y, y + 1 - lo[1]), min(hi[2] - z, z + 1 - lo[2])
                        )
                        deepest = max(deepest, deep)
        out[i] = deepest
