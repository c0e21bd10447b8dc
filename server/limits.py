"""Every bound of the server, with its unit; what is reached is answered with a close code, never with a queue."""

from dataclasses import dataclass

from shared.blocks import PACKED_MAX


@dataclass(frozen=True)
class Limits:
    """Bounds per server and per client."""

    clients_max: int = 2000
    hello_s: float = 5.0
    """A connection that has not introduced itself by then is closed."""
    silence_s: float = 15.0
    """A client that has sent nothing for so long is closed."""
    stalled_s: float = 10.0
    """A client that could not be sent a snapshot for so long is closed."""
    messages_per_tick: float = 8.0
    """A client's messages beyond this rate (with a burst of 32 ticks' worth) close it."""
    gate_bytes: int = 16 * 1024
    """While more than this, and more than two snapshots, is on its way to a client, it is sent nothing new."""
    terrain_bytes_per_tick: int = 12 * 1024
    """Terrain goes behind snapshots in portions of about this size."""
    see_radius: int = 1
    """A client sees the segments at most so many segments away from its own,"""
    keep_radius: int = 2
    """and lets go of those further away than this."""

    def __post_init__(self) -> None:
        assert self.see_radius <= self.keep_radius
        assert self.gate_bytes + PACKED_MAX < 1 << 20
