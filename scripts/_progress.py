"""Whether a player gets anywhere: inputs that the server used, and blocks walked."""

from collections import deque
from typing import NamedTuple

WITHIN_S = 2.0
"""A player is to move again within this time, in seconds, from the first snapshot after a stall on."""
GAP_S = 0.5
"""The time without a snapshot, in seconds, that counts as a stall."""
WALKED_MIN = 0.5
"""The way, in blocks, that a player who walks all the time covers at least in `WITHIN_S`."""


class _Look(NamedTuple):
    at: float
    used: int
    walked: float


class Progress:
    """Counts the seconds in which snapshots came, but nothing that the player wished had happened for `WITHIN_S`.

    Snapshots alone say nothing: a server goes on sending them to a client whose inputs it refuses.

    Args:
        walks: the player walks all the time, so that the way counts as well.
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
        """The player has no connection, or another one: the time begins anew."""
        self._looks.clear()
