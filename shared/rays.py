"""Rays through boxes and blocks, computed exactly: a float is a fraction of whole numbers, so nothing is rounded.

A ray hits a box if they share more than a point. A ray that only touches an edge or a corner passes. A ray within a
face hits the box above that face, because a box is closed at its low sides and open at its high sides. If a ray starts
inside a box, its distance is 0. `t` is the parameter of a point on the ray: origin + t * direction.
"""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction

from shared.checks import Cell, SceneError, Vec, finite, vector
from shared.units import RANGE_BLOCKS

LENGTH_MAX = 1024.0
"""Maximum length of a ray, in blocks."""


class Ray:
    """A ray of limited length.

    Args:
        origin: start of the ray in blocks.
        direction: direction of the ray, of any length except zero.
        length: length of the ray in blocks, at most 1024.

    Raises:
        SceneError: a number is not finite or out of range, or the direction is zero.
    """

    def __init__(self, origin: Sequence[float], direction: Sequence[float], length: float) -> None:
        self.origin = vector(origin, "origin")
        self.direction = vector(direction, "direction")
        if max(map(abs, self.origin)) > RANGE_BLOCKS:
            raise SceneError(f"origin = {origin!r}: must be within +-{RANGE_BLOCKS} blocks")
        if not any(self.direction):
            raise SceneError(f"direction = {direction!r}: must not be zero")
        self.length = finite(length, "length")
        if not 0 <= self.length <= LENGTH_MAX:
            raise SceneError(f"length = {length!r}: must be from 0 to {LENGTH_MAX:g} blocks")
        self._way = [Fraction(part) for part in self.direction]
        self._longest = max(map(abs, self._way))
        self._norm = math.hypot(*(float(part / self._longest) for part in self._way))

    def distance(self, t: Fraction) -> float:
        """Returns the distance of the point `t` from the origin, in blocks."""
        return float(t * self._longest) * self._norm

    def point(self, t: Fraction) -> Vec:
        """Returns the position of the point `t` in blocks. Each coordinate is rounded once."""
        x, y, z = (float(Fraction(a) + t * way) for a, way in zip(self.origin, self._way, strict=True))
        return x, y, z

    def enters(self, low: Sequence[float], high: Sequence[float]) -> Fraction | None:
        """Returns the `t` at which the ray enters the box between two corners; None if it misses or is too short."""
        first, last = Fraction(0), None
        for a, way, lo, hi in zip(self.origin, self._way, low, high, strict=True):
            if not way:
                if not lo <= a < hi:
                    return None
                continue
            ends = ((Fraction(lo) - Fraction(a)) / way, (Fraction(hi) - Fraction(a)) / way)
            first = max(first, min(ends))
            last = max(ends) if last is None else min(last, max(ends))
        assert last is not None
        return first if first < last and self.distance(first) <= self.length else None

    def meets(self, solid: Callable[[Cell], bool]) -> tuple[Cell, Fraction] | None:
        """Returns the first solid block on the ray and the `t` at which the ray enters it; None: there is none.

        The crossings of the block planes of all three axes get one denominator, so they are whole numbers that can be
        compared and added for any direction. If two crossings coincide, the ray goes through an edge.

        Args:
            solid: returns whether a block stops the ray.
        """
        ones = [part.as_integer_ratio() for part in self.origin]
        one = max(den for _, den in ones)  # all are powers of two, so the greatest is a multiple of the others
        ways = [part.as_integer_ratio() for part in self.direction]
        unit = max(den for _, den in ways)
        way = [num * (unit // den) for num, den in ways]
        product = math.prod(abs(part) for part in way if part)
        cell, next_at, gap = [0, 0, 0], [0, 0, 0], [0, 0, 0]
        for k, ((num, den), part) in enumerate(zip(ones, way, strict=True)):
            a = num * (one // den)
            cell[k] = (a - 1) // one if part < 0 else a // one
            if part:
                scale = product // abs(part)
                next_at[k] = abs((cell[k] + (part > 0)) * one - a) * scale
                gap[k] = one * scale
        axes = [(k, 1 if part > 0 else -1) for k, part in enumerate(way) if part]
        to_t = Fraction(unit, product * one)
        num, den = (to_t * self._longest).as_integer_ratio()
        at = 0
        while at * num / den * self._norm <= self.length:
            if solid((cell[0], cell[1], cell[2])):
                return (cell[0], cell[1], cell[2]), at * to_t
            at = min(next_at[k] for k, _ in axes)
            for k, sign in axes:
                if next_at[k] == at:
                    cell[k] += sign
                    next_at[k] += gap[k]
        return None
