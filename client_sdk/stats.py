"""Statistics of a client's connection and prediction, to read while playing and to draw over the view."""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from client_sdk.events import Corrected

CORRECTIONS_KEPT = 1000
"""Number of the newest corrections whose size is kept."""
RATE_S = 1.0
"""Time between two measurements of the rates, in seconds."""
ROUND_TRIPS = 3
"""Number of pongs whose median is the round trip, so that a single late pong is not shown."""
LATE_S = 5.0
"""The time that `late_share_lately` covers, in seconds."""
CORRECTIONS_S = 60.0
"""The time that `corrections_lately` covers, in seconds."""


class _Mark(NamedTuple):
    """The counters at the time `at`, in seconds."""

    at: float
    bytes_up: int
    bytes_down: int
    inputs_sent: int
    inputs_late: int
    corrections_by_cause: dict[str, int]


class CorrectionTime(NamedTuple):
    """A correction on a time line: when it was made (seconds of the program's clock), its cause, its size in blocks."""

    at: float
    cause: str
    blocks: float


@dataclass
class Stats:
    """Counters since the start, and current measurements. Lengths in blocks, times in seconds."""

    rtt_s: float = 0.0
    """Round trip in seconds: the median of the last three pongs, which come once per second."""
    lead_ticks: float = 0.0
    """Lead of the client's timeline over the server time, in ticks."""
    lead_s: float = 0.0
    """Lead of the client's timeline over the server time, in seconds; what exceeds half the round trip covers jitter
    and loss."""
    snapshot_age_s: float = 0.0
    """Age of the confirmed world: the server time minus the tick of the newest snapshot, in seconds."""
    bytes_up_per_s: float = 0.0
    """Rate of sent bytes in the last second; messages only, without the headers of WebSocket and TCP."""
    bytes_down_per_s: float = 0.0
    """Rate of received bytes in the last second; messages only, without the headers of WebSocket and TCP."""
    bytes_up: int = 0
    bytes_down: int = 0
    inputs_sent: int = 0
    inputs_used: int = 0
    """Number of ticks for which the server used the input that was sent for them."""
    inputs_late: int = 0
    """Number of inputs that arrived after their deadline."""
    inputs_refused: int = 0
    """Number of inputs that the server refused, because they arrived much too early or twice."""
    inputs_substituted: int = 0
    """Number of ticks for which the server had no input: it repeated the latest one, or used none."""
    inputs_neutralised: int = 0
    """Number of ticks in which the server used no input, because it had already repeated the latest one for 0.3125 s;
    also counted in `inputs_substituted`."""
    snapshots: int = 0
    snapshots_skipped: int = 0
    """Number of ticks without a snapshot of their own; the next snapshot covered them."""
    corrections: int = 0
    corrections_by_cause: dict[str, int] = field(default_factory=dict)
    correction_blocks: list[float] = field(default_factory=list)
    """Sizes of the newest corrections in blocks, at most 1,000, oldest first."""
    repredictions: int = 0
    """Number of replays for which only other entities differed."""
    replayed_ticks: int = 0
    resyncs: int = 0
    """Number of times that prediction started again at another tick (`Resynchronised`)."""
    reconnects: int = 0
    divergences: int = 0
    """Number of divergences (`Diverged`); must be 0."""
    kernel: str = ""
    """Form of the kernel that computes the physics: `prebuilt`, `numba` or `plain` (`shared.kernels`), or `plain for
    now` while Numba compiles; empty before there is a world."""
    correction_times: deque[CorrectionTime] = field(default_factory=lambda: deque(maxlen=CORRECTIONS_KEPT), repr=False)
    """The newest corrections with their times, oldest first, for a time line."""
    measured_at: float = 0.0
    """Time of the latest measurement (`measure`), in seconds of the program's clock."""
    _began_at: float | None = field(default=None, repr=False)
    _marks: deque[_Mark] = field(default_factory=deque, repr=False)
    """Counters at one time per second, for the last `CORRECTIONS_S` seconds, oldest first."""
    _round_trips: deque[float] = field(default_factory=lambda: deque(maxlen=ROUND_TRIPS), repr=False)

    @property
    def played_s(self) -> float:
        """The time since the player joined, in seconds."""
        return 0.0 if self._began_at is None else self.measured_at - self._began_at

    @property
    def late_share(self) -> float:
        """The share of late inputs in all inputs since the start, 0 to 1."""
        return self.inputs_late / max(self.inputs_sent, 1)

    @property
    def late_share_lately(self) -> float:
        """The share of late inputs in the inputs of the last 5 s, 0 to 1."""
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
        self.correction_times.append(CorrectionTime(self.measured_at, correction.cause, correction.blocks))

    def pinged(self, round_trip_s: float) -> None:
        """Adds a measured round trip, in seconds."""
        self._round_trips.append(round_trip_s)
        self.rtt_s = sorted(self._round_trips)[(len(self._round_trips) - 1) // 2]

    def measure(self, now: float) -> None:
        """Measures the rates and keeps the counters, at most once per second. May be called more often."""
        self.measured_at = now
        if self._began_at is None:
            self._began_at = now
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
        """Returns the newest mark that is at least `seconds` older than the last mark; None if there is none."""
        if not self._marks:
            return None
        end = self._marks[-1].at - seconds
        return next((mark for mark in reversed(self._marks) if mark.at <= end), None)

    def figures(self) -> list[tuple[str, str]]:
        """Returns pairs of name and value as a game would show them: current measurements, corrections, alarms.

        Late inputs are of the last 5 s, and corrections of the last minute. Reconnects and divergences count since the
        start, and are left out if there are none.
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
        """Returns the pairs of `figures` as lines of equal length."""
        return "\n".join(f"{name:<16}{value:>10}" for name, value in self.figures())
