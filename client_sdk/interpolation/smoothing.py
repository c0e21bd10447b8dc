"""Smoothing: after a correction the simulated position jumps, and the drawn position follows gradually."""

HALF_LIFE_S = 0.1
"""Time in which the visual offset halves, in seconds."""
FADED_S = 6.0
"""Time after which nothing of an offset is left: less than 2^-57 blocks, in seconds."""
TELEPORT_BLOCKS = 4.0
"""Longest offset that is smoothed, in blocks; a longer one is shown as a jump."""

Offset = tuple[float, float, float]


class Smoothing:
    """The visual offset of one entity in blocks. It halves every 100 ms, independent of the frame rate."""

    def __init__(self) -> None:
        self._offset: Offset = (0.0, 0.0, 0.0)
        self._since = 0.0

    def add(self, offset: Offset, now: float) -> None:
        """Adds the offset of a jump: the old position minus the new one, in blocks."""
        old = self.offset(now)
        x, y, z = (a + b for a, b in zip(old, offset, strict=True))
        self._since = now
        self._offset = (x, y, z) if x * x + y * y + z * z <= TELEPORT_BLOCKS**2 else (0.0, 0.0, 0.0)

    def offset(self, now: float) -> Offset:
        """Returns the offset to add to the simulated position, in blocks."""
        since = max(now - self._since, 0.0)
        if since > FADED_S:
            return 0.0, 0.0, 0.0
        left = 0.5 ** (since / HALF_LIFE_S)
        x, y, z = self._offset
        return x * left, y * left, z * left
