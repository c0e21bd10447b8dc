"""What the network does to a player, in numbers: to watch while playing, and to draw over the picture."""

from dataclasses import dataclass, field

from client_sdk.events import Corrected

CORRECTIONS_KEPT = 1000
RATE_S = 1.0


@dataclass
class Stats:
    """Counters since the start, and figures of the moment. Lengths in blocks, times in seconds."""

    rtt_s: float = 0.0
    """The least round trip of the last 15 s: the path without its queues."""
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
    _measured: tuple[float, int, int] | None = field(default=None, repr=False)

    @property
    def late_share(self) -> float:
        """Of all inputs, 0 to 1."""
        return self.inputs_late / max(self.inputs_sent, 1)

    def corrected(self, correction: Corrected) -> None:
        """Counts a correction."""
        self.corrections += 1
        self.corrections_by_cause[correction.cause] = self.corrections_by_cause.get(correction.cause, 0) + 1
        self.correction_blocks.append(correction.blocks)
        del self.correction_blocks[:-CORRECTIONS_KEPT]

    def measure(self, now: float) -> None:
        """Takes the rates once a second; call it as often as you like."""
        since, up, down = self._measured or (now, self.bytes_up, self.bytes_down)
        if self._measured is None or now - since >= RATE_S:
            if now > since:
                self.bytes_up_per_s = (self.bytes_up - up) / (now - since)
                self.bytes_down_per_s = (self.bytes_down - down) / (now - since)
            self._measured = now, self.bytes_up, self.bytes_down

    def figures(self) -> list[tuple[str, str]]:
        """Names and values, as a game would show them: what matters, then what has happened."""
        figures = [
            ("round trip", f"{self.rtt_s * 1000:.0f} ms"),
            ("lead", f"{self.lead_s * 1000:.0f} ms"),
            ("snapshot age", f"{self.snapshot_age_s * 1000:.0f} ms"),
            ("up", f"{self.bytes_up_per_s / 1000:.1f} kB/s"),
            ("down", f"{self.bytes_down_per_s / 1000:.1f} kB/s"),
            ("late inputs", f"{100 * self.late_share:.2f} %"),
            ("corrections", f"{self.corrections}"),
        ]
        figures += [(f"  {cause}", f"{count}") for cause, count in sorted(self.corrections_by_cause.items())]
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
