"""Hides a correction from the eye: the simulation jumps, the picture follows."""

HALF_LIFE_S = 0.1
TELEPORT_BLOCKS = 4.0
"""A longer way than this is shown as the jump it is."""

Offset = tuple[float, float, float]


class Smoothing:
    """A visual offset that halves every 100 ms, however often it is looked at."""

    def __init__(self) -> None:
        self._offset: Offset = (0.0, 0.0, 0.0)
        self._since = 0.0

    def add(self, offset: Offset, now: float) -> None:
        """The thing has jumped by -offset: go on showing it where it was."""
        old = self.offset(now)
        x, y, z = (a + b for a, b in zip(old, offset, strict=True))
        self._since = now
        self._offset = (x, y, z) if x * x + y * y + z * z <= TELEPORT_BLOCKS**2 else (0.0, 0.0, 0.0)

    def offset(self, now: float) -> Offset:
        """What to add to the simulated position, in blocks."""
        left = 0.5 ** (max(now - self._since, 0.0) / HALF_LIFE_S)
        x, y, z = self._offset
        return x * left, y * left, z * left
