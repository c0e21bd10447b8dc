/* The step of shared/kernel.py in C: the same algorithm on the same arrays, as a measure of the kernel's speed. It has
   no acceleration and no friction.
   step_c.py builds and calls it. Only scripts/bench.py uses it, and checks that both reach the same hash. */
#include <stdint.h>

typedef int64_t i64;
enum {ID, TEMPLATE, FLAGS, X, Y, Z, VX, VY, VZ, MOVE_X, MOVE_Y, BUTTONS, CELL, NEXT, PREV, CHANGED, WIDTH};
enum {LO_X, SIZE_X = 3, SOLID = 6, WALKS, JUMP_SPEED, WEIGHT, TEMPLATE_COLUMNS = 18};
enum {GRAVITY, TERMINAL, RATE, EXACT, MEAN, PAIRS, FLOOR, REACH_LO, REACH_HI = 10};
enum {N_AWAKE, N_WOKEN, N_CHANGED, N_FELL, N_LATER, N_HOMELESS, N_STEPPED};
enum {FALLING = 1, AWAKE = 2, JUMP = 1, MOVES = 255, MOVE_MAX = 127, NOWHERE = 0, CANDIDATE = 7};
enum {BITS = 24, SEGMENT_BITS = 29, CELL_BITS = 26, CELL_BITS_Z = 28, CELLS_SHIFT = 7, CELLS = 128};
#define BLOCK ((i64)1 << BITS)
#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))

typedef struct { /* shared.layout.Arrays, and one length */
    i64 *e, *t, *walk, *p;
    uint32_t *solid;
    i64 *segments, *table;
    int32_t *heads;
    i64 *awake, *next_awake, *woken, *later, *found, *changed, *fell, *n, *near, *riders, table_length;
} W;

static inline i64 segment_row(W *w, i64 x, i64 y, i64 z) {
    i64 *near = w->near;
    if (near[0] == x && near[1] == y && near[2] == z) return near[3];
    i64 mask = w->table_length - 1, row = NOWHERE;
    for (i64 at = (x * 73856093 ^ y * 19349663 ^ z * 83492791) & mask; w->table[at]; at = (at + 1) & mask) {
        i64 *s = w->segments + 3 * (w->table[at] - 1);
        if (s[0] == x && s[1] == y && s[2] == z) { row = w->table[at] - 1; break; }
    }
    near[0] = x; near[1] = y; near[2] = z; near[3] = row;
    return row;
}

static inline int solid_in(W *w, i64 x0, i64 y0, i64 z0, i64 x1, i64 y1, i64 z1) {
    for (i64 z = z0; z <= z1; z++)
        for (i64 y = y0; y <= y1; y++)
            for (i64 x = x0, last; x <= x1; x = last + 1) {
                last = MIN(x1, x | 31);
                i64 row = segment_row(w, x >> 5, y >> 5, z >> 5);
                if (row == NOWHERE) { if (z >= w->p[FLOOR]) return 1; continue; }
                i64 wanted = (((i64)2 << (last - x)) - 1) << (x & 31);
                if (w->solid[row << 10 | (z & 31) << 5 | (y & 31)] & wanted) return 1;
            }
    return 0;
}

static inline i64 cell_at(W *w, i64 x, i64 y, i64 z) {
    return segment_row(w, x >> 3, y >> 3, z >> 1) << CELLS_SHIFT | (z & 1) << 6 | (y & 7) << 3 | (x & 7);
}

static inline i64 gather(W *w, i64 but, i64 x0, i64 y0, i64 z0, i64 x1, i64 y1, i64 z1) {
    i64 *p = w->p, n = 0;
    for (i64 cz = (z0 - p[REACH_HI + 2]) >> CELL_BITS_Z; cz <= (z1 + p[REACH_LO + 2]) >> CELL_BITS_Z; cz++)
    for (i64 cy = (y0 - p[REACH_HI + 1]) >> CELL_BITS; cy <= (y1 + p[REACH_LO + 1]) >> CELL_BITS; cy++)
    for (i64 cx = (x0 - p[REACH_HI]) >> CELL_BITS; cx <= (x1 + p[REACH_LO]) >> CELL_BITS; cx++) {
        i64 cell = cell_at(w, cx, cy, cz);
        for (i64 row = w->heads[cell]; row >= 0;) {
            i64 *e = w->e + row * WIDTH, *t = w->t + e[TEMPLATE] * TEMPLATE_COLUMNS;
            int here = cell >= CELLS || (e[X] >> CELL_BITS == cx && e[Y] >> CELL_BITS == cy && e[Z] >> CELL_BITS_Z == cz);
            if (here && row != but && t[SOLID]) {
                i64 x = e[X] + t[LO_X], y = e[Y] + t[LO_X + 1], z = e[Z] + t[LO_X + 2];
                i64 hx = x + t[SIZE_X], hy = y + t[SIZE_X + 1], hz = z + t[SIZE_X + 2];
                if (x <= x1 && hx >= x0 && y <= y1 && hy >= y0 && z <= z1 && hz >= z0) {
                    i64 *f = w->found + n;
                    f[0] = x; f[1] = y; f[2] = z; f[3] = hx; f[4] = hy; f[5] = hz; f[6] = row;
                    n += CANDIDATE;
                }
            }
            row = e[NEXT];
        }
    }
    return n;
}

static void unlink_row(W *w, i64 row) {
    i64 *e = w->e + row * WIDTH;
    if (e[CELL] < 0) return;
    if (e[PREV] >= 0) w->e[e[PREV] * WIDTH + NEXT] = e[NEXT]; else w->heads[e[CELL]] = e[NEXT];
    if (e[NEXT] >= 0) w->e[e[NEXT] * WIDTH + PREV] = e[PREV];
    w->n[N_HOMELESS] -= e[CELL] < CELLS;
    e[CELL] = -1;
}

static void relink(W *w, i64 row) {
    i64 *e = w->e + row * WIDTH, cell = cell_at(w, e[X] >> CELL_BITS, e[Y] >> CELL_BITS, e[Z] >> CELL_BITS_Z);
    if (cell == e[CELL]) return;
    unlink_row(w, row);
    i64 first = w->heads[cell];
    e[CELL] = cell; e[PREV] = -1; e[NEXT] = first;
    if (first >= 0) w->e[first * WIDTH + PREV] = row;
    w->heads[cell] = row;
    w->n[N_HOMELESS] += cell < CELLS;
}

static void push(i64 *heap, i64 n, i64 key) {
    while (n > 0 && heap[(n - 1) >> 1] > key) { heap[n] = heap[(n - 1) >> 1]; n = (n - 1) >> 1; }
    heap[n] = key;
}

static i64 pop(i64 *heap, i64 n) {
    i64 least = heap[0], key = heap[--n], at = 0;
    for (i64 child; (child = 2 * at + 1) < n; at = child) {
        if (child + 1 < n && heap[child + 1] < heap[child]) child++;
        if (heap[child] >= key) break;
        heap[at] = heap[child];
    }
    heap[at] = key;
    return least;
}

static void wake(W *w, i64 row, i64 turn) {
    i64 *e = w->e + row * WIDTH, key = e[ID] << 32 | row;
    if (e[FLAGS] & AWAKE) return;
    e[FLAGS] |= AWAKE;
    if (key > turn) push(w->woken, w->n[N_WOKEN]++, key);
    else w->later[w->n[N_LATER]++] = key;
}

static i64 displacement(i64 *p, i64 sum) {
    i64 rate = p[RATE];
    if (p[EXACT]) return sum * p[EXACT];
    return sum >= 0 ? (sum * 256 + rate) / (2 * rate) : -((rate - sum * 256) / (2 * rate));
}

static inline int layer_solid(W *w, int k, i64 layer, i64 i0, i64 i1, i64 j0, i64 j1) {
    i0 >>= BITS; i1 = (i1 - 1) >> BITS; j0 >>= BITS; j1 = (j1 - 1) >> BITS;
    if (k == 0) return solid_in(w, layer, i0, j0, layer, i1, j1);
    if (k == 1) return solid_in(w, j0, layer, i0, j1, layer, i1);
    return solid_in(w, i0, j0, layer, i1, j1, layer);
}

static inline __attribute__((always_inline))
i64 sweep(W *w, int k, i64 d, i64 n, i64 a0, i64 a1, i64 i0, i64 i1, i64 j0, i64 j1) {
    int i = (k + 1) % 3, j = (k + 2) % 3;
    i64 sign = d > 0 ? 1 : -1, lead = d > 0 ? a1 - 1 : a0, layer = lead >> BITS, last = (lead + d) >> BITS;
    while (layer != last) {
        layer += sign;
        if (layer_solid(w, k, layer, i0, i1, j0, j1)) {
            d = d > 0 ? (layer << BITS) - a1 : ((layer + 1) << BITS) - a0;
            break;
        }
    }
    for (i64 *c = w->found, *end = c + n; c < end; c += CANDIDATE)
        if (c[i] < i1 && c[i + 3] > i0 && c[j] < j1 && c[j + 3] > j0) {
            if (d > 0) { if (c[k] >= a1) d = MIN(d, c[k] - a1); }
            else if (c[k + 3] <= a0) d = MAX(d, c[k + 3] - a0);
        }
    return d;
}

static int on_entity(W *w, i64 n, i64 x0, i64 y0, i64 x1, i64 y1, i64 z) {
    for (i64 *c = w->found, *end = c + n; c < end; c += CANDIDATE)
        if (c[5] == z && c[0] < x1 && c[3] > x0 && c[1] < y1 && c[4] > y0) return 1;
    return 0;
}

static int supported(W *w, i64 row, int meets, i64 x0, i64 y0, i64 x1, i64 y1, i64 z) {
    i64 below = (z >> BITS) - 1;
    if (!(z & (BLOCK - 1)) && solid_in(w, x0 >> BITS, y0 >> BITS, below, (x1 - 1) >> BITS, (y1 - 1) >> BITS, below))
        return 1;
    return meets && on_entity(w, gather(w, row, x0, y0, z, x1, y1, z), x0, y0, x1, y1, z);
}

static int turn(W *w, i64 row, i64 key, i64 tick) {
    i64 *e = w->e + row * WIDTH, *p = w->p, *t = w->t + e[TEMPLATE] * TEMPLATE_COLUMNS;
    for (int k = 0; k < 3; k++) w->near[k] = e[X + k] >> SEGMENT_BITS;
    w->near[3] = e[CELL] >> CELLS_SHIFT;
    i64 x0 = e[X] + t[LO_X], y0 = e[Y] + t[LO_X + 1], z0 = e[Z] + t[LO_X + 2];
    i64 x1 = x0 + t[SIZE_X], y1 = y0 + t[SIZE_X + 1], z1 = z0 + t[SIZE_X + 2];
    i64 vx = e[VX], vy = e[VY], vz = e[VZ], falling = e[FLAGS] & FALLING;
    int meets = p[PAIRS] && t[SOLID], walks = 0, jumps = 0, moved = 0;
    if (t[WALKS]) {
        i64 *walk = w->walk + e[TEMPLATE] * MOVES + MOVE_MAX;
        walks = e[MOVE_X] || e[MOVE_Y];
        vx = walk[e[MOVE_X]];
        vy = walk[e[MOVE_Y]];
    }
    i64 from_vz = vz;
    if (t[WEIGHT]) {
        jumps = e[BUTTONS] & JUMP && t[JUMP_SPEED];
        if (!falling || jumps) {
            if (!supported(w, row, meets, x0, y0, x1, y1, z0)) falling = FALLING;
            else if (jumps) { vz = t[JUMP_SPEED]; falling = FALLING; }
        }
        from_vz = vz;
        if (falling) vz = MAX(vz - t[WEIGHT], -p[TERMINAL]);
        if (!p[MEAN]) from_vz = vz;
    }
    if (from_vz || vz || vx || vy) {
        i64 dx = displacement(p, 2 * vx), dy = displacement(p, 2 * vy), dz = displacement(p, from_vz + vz), n = 0;
        i64 went_x = 0, went_y = 0, went_z = 0;
        if (meets)
            n = gather(w, row, x0 + MIN(dx, 0), y0 + MIN(dy, 0), z0 + MIN(dz, 0),
                       x1 + MAX(dx, 0), y1 + MAX(dy, 0), z1 + MAX(dz, 0));
        if (dz && (went_z = sweep(w, 2, dz, n, z0, z1, x0, x1, y0, y1)) != dz) {
            vz = 0;
            if (dz < 0) falling = 0;
        }
        if (dx && (went_x = sweep(w, 0, dx, n, x0, x1, y0, y1, z0 + went_z, z1 + went_z)) != dx) vx = 0;
        if (dy && (went_y = sweep(w, 1, dy, n, y0, y1, z0 + went_z, z1 + went_z, x0 + went_x, x1 + went_x)) != dy) vy = 0;
        if (went_x || went_y || went_z) {
            i64 x = e[X], y = e[Y], z = e[Z];
            moved = 1;
            e[X] += went_x; e[Y] += went_y; e[Z] += went_z;
            if (((x ^ e[X]) | (y ^ e[Y]) | (z ^ e[Z])) >> CELL_BITS) relink(w, row);
            if (p[GRAVITY])
                for (i64 *c = w->found, *end = c + n; c < end; c += CANDIDATE)
                    if (c[2] == z1 && c[0] < x1 && c[3] > x0 && c[1] < y1 && c[4] > y0) wake(w, c[6], key);
            z0 += went_z;
        }
    }
    if (moved || vx != e[VX] || vy != e[VY] || vz != e[VZ] || falling != (e[FLAGS] & FALLING)) {
        e[VX] = vx; e[VY] = vy; e[VZ] = vz;
        e[FLAGS] = (e[FLAGS] & ~(i64)FALLING) | falling;
        if (e[CHANGED] != tick) { e[CHANGED] = tick; w->changed[w->n[N_CHANGED]++] = row; }
    }
    if (z0 >> BITS < p[FLOOR]) w->fell[w->n[N_FELL]++] = e[ID];
    return moved || falling || vx || vy || vz || walks || jumps;
}

void step(W *w, i64 tick) {
    i64 *n = w->n, at = 0, kept = 0, last = -1, key;
    if (n[N_STEPPED]) n[N_CHANGED] = 0;
    n[N_STEPPED] = n[N_FELL] = 0;
    while (at < n[N_AWAKE] || n[N_WOKEN] > 0) {
        if (n[N_WOKEN] > 0 && (at >= n[N_AWAKE] || w->woken[0] < w->awake[at])) key = pop(w->woken, n[N_WOKEN]--);
        else key = w->awake[at++];
        i64 row = key & 0xffffffff;
        if (key == last || w->e[row * WIDTH + ID] != key >> 32) continue;
        last = key;
        if (turn(w, row, key, tick)) w->next_awake[kept++] = key;
        else w->e[row * WIDTH + FLAGS] &= ~(i64)AWAKE;
    }
    for (i64 i = 0; i < kept; i++) w->awake[i] = w->next_awake[i];
    n[N_AWAKE] = kept;
    for (i64 i = 0; i < n[N_LATER]; i++) push(w->woken, i, w->later[i]);
    n[N_WOKEN] = n[N_LATER];
    n[N_LATER] = 0;
    n[N_STEPPED] = 1;
}
