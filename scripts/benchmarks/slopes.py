"""Straight lines through measurements: what one more player costs, what is left without players, and the scatter."""

import math
import statistics
from collections.abc import Sequence
from typing import NamedTuple

SURE = 2.0
"""Number of standard errors that are given as the scatter of a figure. A figure that is not above them is no result."""


class Figure(NamedTuple):
    """A figure and its scatter."""

    value: float
    scatter: float

    @property
    def found(self) -> bool:
        """Whether the figure is above its scatter. Otherwise it is no result."""
        return self.value > self.scatter

    def __str__(self) -> str:
        """Returns the figure with its scatter, or that it is below what can be measured."""
        digits = 0 if max(abs(self.value), self.scatter) >= 100 else 1 if self.scatter >= 0.1 else 2
        scatter = f"+-{self.scatter:.{digits}f}"
        return f"{self.value:.{digits}f} {scatter}" if self.found else f"below what can be measured ({scatter})"

    def over(self, other: "Figure") -> "Figure":
        """Returns the ratio to a figure that was found, whose scatter does not depend on this one's."""
        ratio = self.value / other.value
        return Figure(ratio, math.hypot(self.scatter, ratio * other.scatter) / other.value)


def mean(values: Sequence[float]) -> Figure:
    """Returns the mean of at least two values."""
    return Figure(statistics.fmean(values), SURE * statistics.stdev(values) / math.sqrt(len(values)))


class Line(NamedTuple):
    """The line through measurements: the cost per player, and the cost without players."""

    per: Figure
    base: Figure


def fit(points: Sequence[tuple[float, float]]) -> Line:
    """Returns the line of least squares.

    Args:
        points: numbers of players and what was measured with them: at least three points, and two different numbers.
    """
    slope, base = statistics.linear_regression([x for x, _ in points], [y for _, y in points])
    middle = statistics.fmean(x for x, _ in points)
    spread = math.fsum((x - middle) ** 2 for x, _ in points)
    rest = math.fsum((y - base - slope * x) ** 2 for x, y in points) / (len(points) - 2)
    per, at_0 = math.sqrt(rest / spread), math.sqrt(rest * (1 / len(points) + middle**2 / spread))
    return Line(Figure(slope, SURE * per), Figure(base, SURE * at_0))
