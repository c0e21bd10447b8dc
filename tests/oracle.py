"""A second implementation of the physics contract, in exact rationals and without optimisations.

It has no grid integers, no cells and no sleep. Blocks are a set and entities a dictionary. Every entity has a turn in
every tick, in ascending order of id. An obstacle is a box, and a move ends at the nearest obstacle.
Only `fractions.Fraction` decides. The integer test `near` merely skips what is provably out of reach.

    1  supported?   a solid block or a solid entity touches the underside exactly, with an area
    2  input        walkers: horizontal velocity = intent x walk speed; jump only when supported
    3  gravity      v' = max(v - g dt, -v_t), with the flag up
       grip         kinds with acceleration or friction: the horizontal velocity approaches that of step 2
    4  move         z, x, y: displacement rounded once to 2^-24 block, clamped to the first face newly reached
    5  flag         cleared only when a downward motion was stopped
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

Block = tuple[int, int, int]
Box = tuple[list[Fraction], list[Fraction]]

STEP = Fraction(1, 1 << 24)
SPEED_STEP = Fraction(1, 1 << 16)
SEGMENT = 32


def nearest(value: Fraction, width: Fraction) -> Fraction:
    """Returns the nearest multiple of `width`; halves are rounded away from zero."""
    count, each = abs(value.numerator) * width.denominator, value.denominator * width.numerator
    whole = (2 * count + each) // (2 * each)
    return Fraction((whole if value >= 0 else -whole) * width.numerator, width.denominator)


@dataclass
class Kind:
    """A template: the box relative to the position, and what the entity may do."""

    offset: list[Fraction]
    size: list[Fraction]
    walk: Fraction
    jump: Fraction
    solid: bool
    gravity: Fraction | None = None
    acceleration: Fraction | None = None
    friction: Fraction | None = None
    air_control: Fraction | None = None

    def corners(self) -> Box:
        """The low and the high corner of the box. A negative side extends it the other way."""
        ends = [o + s for o, s in zip(self.offset, self.size, strict=True)]
        return [min(pair) for pair in zip(self.offset, ends, strict=True)], [
            max(pair) for pair in zip(self.offset, ends, strict=True)
        ]


@dataclass
class Body:
    """An entity."""

    kind: int
    position: list[Fraction]
    velocity: list[Fraction]
    falling: bool = False
    move: tuple[int, int] = (0, 0)
    buttons: int = 0
    near: list[int] = field(default_factory=list)
    corners: Box = field(default_factory=lambda: ([], []))


class Oracle:
    """A world of the contract.

    Args:
        kinds: the templates, in the scene's order, with lengths and speeds as the scene gives them.
        rate: ticks per second.
        lowest: z of the lowest block; the void is below it.
    """

    def __init__(
        self,
        kinds: list[Kind],
        *,
        rate: int,
        gravity: Fraction,
        terminal: Fraction,
        mean: bool,
        pairs: bool,
        lowest: int,
    ) -> None:
        self.kinds = kinds
        self.dt = Fraction(1, rate)
        self.terminal = nearest(terminal, SPEED_STEP)
        self.mean = mean
        self.pairs = pairs
        self.lowest = lowest
        self.solid: dict[Block, set[Block]] = {}
        """Solid blocks of each loaded segment."""
        self.bodies: dict[int, Body] = {}
        self.fell: list[int] = []
        self._corners = [self._rounded(kind) for kind in kinds]
        own = [gravity if kind.gravity is None else kind.gravity for kind in kinds]
        self._falls = [nearest(each * self.dt, SPEED_STEP) for each in own]
        self._reach = 2 + max(math.ceil(abs(part)) for low, high in self._corners for part in (*low, *high))

    def fall(self, kind: int) -> Fraction:
        """The change of the speed by gravity in a tick."""
        return self._falls[kind]

    def is_solid(self, block: Block) -> bool:
        """Returns whether a block stops things. A place that is not loaded stops them; the void does not."""
        loaded = self.solid.get((block[0] // SEGMENT, block[1] // SEGMENT, block[2] // SEGMENT))
        return block[2] >= self.lowest if loaded is None else block in loaded

    def box(self, body: Body) -> Box:
        low, high = self._corners[body.kind]
        return [p + a for p, a in zip(body.position, low, strict=True)], [
            p + b for p, b in zip(body.position, high, strict=True)
        ]

    def step(self, inputs: Mapping[int, tuple[int, ...]]) -> None:
        """Computes one tick. An entity without an input goes on with its latest one."""
        for entity, (x, y, buttons, *_) in inputs.items():
            self.bodies[entity].move = x, y
            self.bodies[entity].buttons = buttons
        self.fell = []
        for body in self.bodies.values():
            body.near = [math.floor(part) for part in body.position]
            body.corners = self.box(body)
        for entity in sorted(self.bodies):
            self._turn(self.bodies[entity])
            if self.bodies[entity].corners[0][2] < self.lowest:
                self.fell.append(entity)

    def taken(self, body: Body) -> bool:
        """Returns whether a body overlaps a block, or an entity that would stop it."""
        low, high = self.box(body)
        if any(self.is_solid(block) for block in _cells(low, high)):
            return True
        meets = self.pairs and self.kinds[body.kind].solid
        return meets and any(
            other is not body
            and self.kinds[other.kind].solid
            and all(c < b and d > a for a, b, c, d in zip(low, high, *self.box(other), strict=True))
            for other in self.bodies.values()
        )

    def _turn(self, body: Body) -> None:
        kind = self.kinds[body.kind]
        low, high = body.corners
        v = body.velocity
        wished = [nearest(kind.walk * part / 127, SPEED_STEP) for part in body.move]
        grips = kind.friction is not None or (kind.acceleration is not None and kind.walk > 0)
        if kind.walk > 0 and not grips:
            v[:2] = wished
        old = v[2]
        fall = self.fall(body.kind)
        if fall > 0:
            jump = nearest(kind.jump, SPEED_STEP) if body.buttons & 1 else Fraction(0)
            if self._supported(body, low, high):
                if jump > 0:
                    body.falling = True
                    old = v[2] = jump
            else:
                body.falling = True
            if body.falling:
                v[2] = max(v[2] - fall, -self.terminal)
            if not self.mean:
                old = v[2]
        if grips:
            self._grip(kind, v, wished, body.falling and fall > 0, any(body.move) and kind.walk > 0)
            if fall == 0:
                rate = nearest(
                    (kind.friction if kind.friction is not None else kind.acceleration or 0) * self.dt, SPEED_STEP
                )
                old = v[2] = max(v[2] - rate, Fraction(0)) if v[2] > 0 else min(v[2] + rate, Fraction(0))
        wish = [
            nearest(v[0] * self.dt, STEP),
            nearest(v[1] * self.dt, STEP),
            nearest((old + v[2]) / 2 * self.dt, STEP),
        ]
        others = self._others(body, max(abs(part) for part in wish)) if any(wish) else []
        for k in (2, 0, 1):
            went = self._way(low, high, k, wish[k], others) if wish[k] else wish[k]
            low[k] += went
            high[k] += went
            body.position[k] += went
            if went != wish[k]:  # the move was stopped
                v[k] = Fraction(0)
                if k == 2 and wish[k] < 0:
                    body.falling = False
        body.near = [math.floor(part) for part in body.position]

    def _grip(self, kind: Kind, v: list[Fraction], wished: list[Fraction], flies: bool, walks: bool) -> None:
        """Lets a horizontal velocity approach the wished one."""
        share = Fraction(1)
        if flies:
            share = kind.air_control if kind.air_control is not None else Fraction(kind.walk > 0)

        def rate(value: Fraction | None) -> Fraction | None:
            return None if value is None else nearest(value * share * self.dt, SPEED_STEP)

        faster = rate(kind.acceleration)
        slower = rate(kind.friction) if kind.friction is not None else faster
        limit = faster if walks else slower
        if walks and v[0] ** 2 + v[1] ** 2 > (nearest(kind.walk, SPEED_STEP) + 2 * SPEED_STEP) ** 2:
            limit = slower or faster
        way = [int((wish - now) / SPEED_STEP) for wish, now in zip(wished, v[:2], strict=True)]
        square = way[0] ** 2 + way[1] ** 2
        if limit is None or square <= (limit / SPEED_STEP) ** 2:
            v[:2] = wished
        else:
            for k in range(2):
                v[k] += nearest(way[k] * limit / math.isqrt(square), SPEED_STEP)

    def _supported(self, body: Body, low: list[Fraction], high: list[Fraction]) -> bool:
        if low[2].denominator == 1:
            under = [low[0], low[1], low[2] - 1], [high[0], high[1], low[2]]
            if any(self.is_solid(block) for block in _cells(*under)):
                return True
        return any(
            d[2] == low[2] and c[0] < high[0] and d[0] > low[0] and c[1] < high[1] and d[1] > low[1]
            for c, d in self._others(body, Fraction(0))
        )

    def _others(self, body: Body, wish: Fraction) -> list[Box]:
        """Returns the boxes of the solid entities that could stop a body within its reach."""
        if not self.pairs or not self.kinds[body.kind].solid:
            return []
        x, y, z = body.near
        reach = 2 * self._reach + math.ceil(wish)
        return [
            other.corners
            for other in self.bodies.values()
            if abs(other.near[2] - z) <= reach
            and abs(other.near[0] - x) <= reach
            and abs(other.near[1] - y) <= reach
            and other is not body
            and self.kinds[other.kind].solid
        ]

    def _way(self, low: list[Fraction], high: list[Fraction], k: int, wish: Fraction, others: list[Box]) -> Fraction:
        """Returns how far a box moves along axis k: to the nearest face ahead of its leading face."""
        ahead_low, ahead_high = list(low), list(high)
        if wish > 0:
            ahead_low[k], ahead_high[k] = high[k], high[k] + wish
        else:
            ahead_low[k], ahead_high[k] = low[k] + wish, low[k]
        faces = [block[k] + (wish < 0) for block in _cells(ahead_low, ahead_high) if self.is_solid(block)]
        i, j = (k + 1) % 3, (k + 2) % 3
        near = [
            c[k] if wish > 0 else d[k]
            for c, d in others
            if c[i] < high[i] and d[i] > low[i] and c[j] < high[j] and d[j] > low[j]
        ]
        stops: list[Fraction | int] = [*faces, *near]
        if wish > 0:
            return min([wish, *(stop - high[k] for stop in stops if stop >= high[k])])
        return max([wish, *(stop - low[k] for stop in stops if stop <= low[k])])

    def _rounded(self, kind: Kind) -> Box:
        offset = [nearest(part, STEP) for part in kind.offset]
        size = [nearest(part, STEP) for part in kind.size]
        return Kind(offset, size, kind.walk, kind.jump, kind.solid).corners()


def _cells(low: list[Fraction], high: list[Fraction]) -> list[Block]:
    """Returns the blocks that the open box between two corners overlaps."""
    spans = [range(math.floor(a), math.ceil(b)) for a, b in zip(low, high, strict=True)]
    return [(x, y, z) for z in spans[2] for y in spans[1] for x in spans[0]]
