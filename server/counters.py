"""What a server counts."""

from dataclasses import dataclass, field

from server.session import InputQueue


@dataclass
class Counters:
    """What has happened since the start."""

    joined: int = 0
    left: int = 0
    resumed: int = 0
    refused: int = 0
    malformed: int = 0
    kicked: int = 0
    inputs_used: int = 0
    inputs_late: int = 0
    inputs_substituted: int = 0
    inputs_refused: int = 0
    snapshots_sent: int = 0
    snapshots_skipped: int = 0
    snapshot_bytes: int = 0
    terrain_bytes: int = 0
    fell_out: int = 0
    resyncs: int = 0
    closed: dict[int, int] = field(default_factory=dict)
    """Clients told to go, by close code."""
    rules_failed: int = 0
    events_dropped: int = 0
    """Events of the rules that waited too long for a slow client, which is told so."""
    corrections: int = 0
    """As the clients report them."""

    def add(self, queue: InputQueue) -> None:
        """Counts in how one player's inputs have fared."""
        self.inputs_used += queue.used
        self.inputs_late += queue.late
        self.inputs_substituted += queue.substituted
        self.inputs_refused += queue.refused
