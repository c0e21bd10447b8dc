"""Detection of players that are stuck although snapshots arrive."""

from collections import deque
from typing import NamedTuple

WITHIN_S = 2.0
"""Time, in seconds from the first snapshot after a stall, within which a player must move again."""
GAP_S = 0.5
"""Time without a snapshot, in seconds, that counts as a stall."""
WALKED_MIN = 0.5
"""Least distance, in blocks, that a walking player covers in `WITHIN_S`."""


class _Look(NamedTuple):
    at: float
    used: int
    walked: float


class Progress:
    """Counts the seconds in which snapshots came, but had no effect of the player's inputs for `WITHIN_S`.

    Snapshots alone prove nothing, because a server goes on sending them to a client whose inputs it refuses.

    Args:
        walks: whether the player walks all the time; if so, it must also cover `WALKED_MIN`.
    """

    def __init__(self, *, walks: bool) -> None:
        self._walks = walks
        self._looks: deque[_Look] = deque()
        self.stuck_s = 0.0

    def see(self, now: float, used: int, walked: float = 0.0) -> None:
        """Takes the state at a new snapshot.

        Args:
            used: number of inputs that the server has used so far.
            walked: blocks walked so far.
        """
        looks = self._looks
        if looks and now - looks[-1].at > GAP_S:
            looks.clear()
        looks.append(_Look(now, used, walked))
        while len(looks) > 1 and looks[1].at <= now - WITHIN_S:
            looks.popleft()
        first = looks[0]
        moves = not self._walks or walked - first.walked >= WALKED_MIN
        if now - first.at >= WITHIN_S and not (used > first.used and moves):
            self.stuck_s += now - looks[-2].at

    def away(self) -> None:
        """Restarts the time, because the player has no connection or a new one."""
        self._looks.clear()
