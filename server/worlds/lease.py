"""The lease of a process in its fleet, which it renews by compare-and-set.

Theory of operation. No clock is shared. A process holds its lease for `HOLD_S` from the moment at which it has *sent*
the latest renewal that succeeded. Another process may remove a lease that it has not seen change for `LEASE_S`, by
compare-and-set with the revision that it has seen. `LEASE_S` is longer, and begins later. So a process whose lease is
removed knows by its own clock that it has lost it, also after it was suspended, and its next renewal is refused. If the
bus does not answer, nobody can remove a lease; its holder stands still until it can renew it.
"""

from typing import NamedTuple

RENEW_S, SOON_S = 1.0, 0.25
"""Seconds between two renewals, and if the figures have changed."""
HOLD_S = 4.0
"""Seconds for which a process has its lease after it has sent a renewal."""
LEASE_S = 6.0
"""Seconds without a renewal after which another process may remove a lease."""


class Request(NamedTuple):
    """A request to the keys of a bus. `what` is "put", "delete" or "get"; a revision of 0: the key has no value yet.

    `number` tells requests apart.
    """

    number: int
    what: str
    key: str
    value: bytes = b""
    revision: int = 0


class Lease:
    """The lease of this process.

    Args:
        me: identifier of the process; it is never used again after the lease is lost.
        nonce: a secret of this process.
    """

    def __init__(self, me: str, nonce: str) -> None:
        self.me, self.nonce = me, nonce
        self.revision = self.beat = 0
        self.until = self.since = float("-inf")
        """Times in seconds until which the lease is held, and since which it has been held without a gap."""
        self.sent_at = float("-inf")
        self.lost = False
        self._sent: dict[int, float] = {}

    def holds(self, now: float) -> bool:
        """Returns whether the process has its lease."""
        return now < self.until and not self.lost

    def due(self, now: float, changed: bool) -> bool:
        """Returns whether to renew the lease now."""
        return now - self.sent_at >= (SOON_S if changed else RENEW_S)

    def sending(self, now: float) -> int:
        """Notes that a renewal is sent. Returns its number."""
        self.beat += 1
        self.sent_at = self._sent[self.beat] = now
        if len(self._sent) > 64:
            del self._sent[next(iter(self._sent))]
        return self.beat

    def renewed(self, beat: int, revision: int, now: float) -> None:
        """Takes the success of a renewal."""
        self.revision = revision
        until = self._sent.get(beat, float("-inf")) + HOLD_S
        if now >= self.until:
            self.since = now
        self.until = max(self.until, until)

    def found(self, beat: int | None, nonce: str, revision: int, now: float) -> None:
        """Takes what the key of the lease has, after a renewal that was refused or not answered.

        Args:
            beat: the renewal; None: the key has no value.
            nonce: the secret of its process.
            revision: the revision.
            now: time in seconds.
        """
        if beat is not None and nonce == self.nonce:
            self.renewed(beat, revision, now)
        elif beat is not None or self.revision:
            self.lost = True
