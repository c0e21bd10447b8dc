"""What the network does to a player, in numbers: to watch while playing, and to draw over the picture."""

from collections import deque
from dataclasses import dataclass, field
from statistics import median_low
from typing import NamedTuple

from client_sdk.events import Corrected

CORRECTIONS_KEPT = 1000
RATE_S = 1.0
ROUND_TRIPS = 3
"""The pongs that the round trip is taken from; the middle one of them, so that a single late one is not shown."""
LATE_S = 5.0
"""The time that `late_share_lately` is about, in seconds."""
CORRECTIONS_S = 60.0
"""The time that `corrections_lately` is about, in seconds."""


class _Mark(NamedTuple):
    """The counters at a time."""

    at: float
    bytes_up: int
    bytes_down: int
    inputs_sent: int
    inputs_late: int
    corrections_by_cause: dict[str, int]


@dataclass
class Stats:
    """Counters since the start, and figures of the moment. Lengths in blocks, times in seconds."""

    rtt_s: float = 0.0
    """The round trip of the last three seconds: of the last three pings, the one in the middle."""
    lead_ticks: float = 0.0
    """How far ahead of the server the own tick is."""
    lead_s: float = 0.0
    """The same in seconds; beyond half the round trip it is what the network costs in latency."""
    snapshot_age_s: float = 0.0
    """How long ago the server's world was as it is known here."""
    bytes_up_per_s: float = 0.0
    """Of the last second, as are those down; messages only, without the headers around them."""
    bytes_down_per_s: float = 0.0
    bytes_up: int = 0
    bytes_down: int = 0
    inputs_sent: int = 0
    inputs_used: int = 0
    """Ticks for which the server used the input that was sent for them."""
    inputs_late: int = 0
    """Came after their tick."""
    inputs_refused: int = 0
    """Came much too early, or twice."""
    inputs_substituted: int = 0
    """Ticks for which there was none: the one before was repeated,"""
    inputs_neutralised: int = 0
    """or, after ten of these, none taken."""
    snapshots: int = 0
    snapshots_skipped: int = 0
    """Ticks without a snapshot, of which the next one told."""
    corrections: int = 0
    corrections_by_cause: dict[str, int] = field(default_factory=dict)
    correction_blocks: list[float] = field(default_factory=list)
    """How far off the latest ones were."""
    repredictions: int = 0
    """Replays that left the own entity where it was."""
    replayed_ticks: int = 0
    resyncs: int = 0
    """Prediction began anew, after a silence."""
    reconnects: int = 0
    divergences: int = 0
    """Alarms; must be 0."""
    kernel: str = ""
    """What computes the physics: `prebuilt`, `numba` or `plain` (`shared.kernels`); empty before there is a world."""
    _marks: deque[_Mark] = field(default_factory=deque, repr=False)
    """One for each second, as far back as anything looks."""
    _round_trips: deque[float] = field(default_factory=lambda: deque(maxlen=ROUND_TRIPS), repr=False)

    @property
    def late_share(self) -> float:
        """The share of late ones in all inputs since the start, 0 to 1."""
        return self.inputs_late / max(self.inputs_sent, 1)

    @property
    def late_share_lately(self) -> float:
        """The share of late ones in the inputs of the last 5 s, 0 to 1."""
        since = self._since(LATE_S)
        late, sent = self.inputs_late, self.inputs_sent
        if since is not None:
            late, sent = late - since.inputs_late, sent - since.inputs_sent
        return min(late / max(sent, 1), 1.0)

    @property
    def corrections_lately(self) -> dict[str, int]:
        """The number of corrections in the last minute, by cause."""
        since = self._since(CORRECTIONS_S)
        before = {} if since is None else since.corrections_by_cause
        counts = ((cause, count - before.get(cause, 0)) for cause, count in self.corrections_by_cause.items())
        return {cause: count for cause, count in sorted(counts) if count}

    def corrected(self, correction: Corrected) -> None:
        """Counts a correction."""
        self.corrections += 1
        self.corrections_by_cause[correction.cause] = self.corrections_by_cause.get(correction.cause, 0) + 1
        self.correction_blocks.append(correction.blocks)
        del self.correction_blocks[:-CORRECTIONS_KEPT]

    def pinged(self, round_trip_s: float) -> None:
        """Takes a round trip."""
        self._round_trips.append(round_trip_s)
        self.rtt_s = median_low(self._round_trips)

    def measure(self, now: float) -> None:
        """Takes the rates and a mark once a second; call it as often as you like."""
        marks = self._marks
        if marks and now - marks[-1].at < RATE_S:
            return
        if marks:
            seconds = now - marks[-1].at
            self.bytes_up_per_s = (self.bytes_up - marks[-1].bytes_up) / seconds
            self.bytes_down_per_s = (self.bytes_down - marks[-1].bytes_down) / seconds
        causes = dict(self.corrections_by_cause)
        marks.append(_Mark(now, self.bytes_up, self.bytes_down, self.inputs_sent, self.inputs_late, causes))
        while len(marks) > 1 and marks[1].at <= now - CORRECTIONS_S:
            marks.popleft()

    def _since(self, seconds: float) -> _Mark | None:
        """The newest mark that is at least so many seconds older than the last one; None: all is newer."""
        if not self._marks:
            return None
        end = self._marks[-1].at - seconds
        return next((mark for mark in reversed(self._marks) if mark.at <= end), None)

    def figures(self) -> list[tuple[str, str]]:
        """Names and values, as a game would show them: how it goes now, then corrections and alarms.

        Late inputs are those of the last 5 s, corrections those of the last minute. Reconnects and divergences, which
        are shown only if there are any, count since the start.
        """
        corrections = self.corrections_lately
        figures = [
            ("round trip", f"{self.rtt_s * 1000:.0f} ms"),
            ("lead", f"{self.lead_s * 1000:.0f} ms"),
            ("snapshot age", f"{self.snapshot_age_s * 1000:.0f} ms"),
            ("up", f"{self.bytes_up_per_s / 1000:.1f} kB/s"),
            ("down", f"{self.bytes_down_per_s / 1000:.1f} kB/s"),
            ("late inputs", f"{100 * self.late_share_lately:.2f} %"),
            ("corrections", f"{sum(corrections.values())}"),
        ]
        figures += [(f"  {cause}", f"{count}") for cause, count in corrections.items()]
        if self.kernel:
            figures.append(("kernel", self.kernel))
        if self.reconnects:
            figures.append(("reconnects", f"{self.reconnects}"))
        if self.divergences:
            figures.append(("DIVERGED", f"{self.divergences}"))
        return figures

    def text(self) -> str:
        """The figures as lines of equal length."""
        return "\n".join(f"{name:<16}{value:>10}" for name, value in self.figures())
