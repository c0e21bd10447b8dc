"""Phases: spreads the ticks of the worlds of one process over the tick's time."""

from bisect import insort


class Phases:
    """The phases of the worlds that tick, each a part of the tick's time from 0 to 1."""

    def __init__(self) -> None:
        self._phases: dict[str, float] = {}
        self._sorted: list[float] = []

    def take(self, name: str) -> float:
        """Returns a phase for a world: the middle of the largest gap between those of the others."""
        self.give(name)
        if not self._sorted:
            phase = 0.0
        else:
            around = zip(self._sorted, [*self._sorted[1:], self._sorted[0] + 1], strict=True)
            gap, before = max((after - before, -before) for before, after in around)
            phase = (gap / 2 - before) % 1
        self._phases[name] = phase
        insort(self._sorted, phase)
        return phase

    def give(self, name: str) -> None:
        """Gives back the phase of a world, if it has one."""
        if name in self._phases:
            self._sorted.remove(self._phases.pop(name))
