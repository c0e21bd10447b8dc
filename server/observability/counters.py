"""The counters of a game."""

from dataclasses import dataclass, field
from typing import Protocol


class InputCounts(Protocol):
    """Counts of one player's inputs; an `InputQueue` has them."""

    used: int
    late: int
    substituted: int
    refused: int


@dataclass
class Counters:
    """Counts since the start of the process. `server.observability.metrics` describes most of them."""

    joined: int = 0
    left: int = 0
    resumed: int = 0
    refused: int = 0
    """Clients refused at their hello: wrong version, wrong scene, no valid token, server full."""
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
    """Connections that the server closed, by close code."""
    rules_failed: int = 0
    events_dropped: int = 0
    """Game events dropped because too many waited for one player. The client is notified."""
    corrections: int = 0
    """Corrections that the clients have reported."""

    def add(self, queue: InputCounts) -> None:
        """Adds the counts of one player's inputs."""
        self.inputs_used += queue.used
        self.inputs_late += queue.late
        self.inputs_substituted += queue.substituted
        self.inputs_refused += queue.refused
