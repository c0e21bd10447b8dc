"""Every bound of the server, with its unit; what is reached is answered with a close code, never with a queue."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Bounds per server and per client."""

    clients_max: int = 2000
    joins_per_tick: int = 8
    """More wait for the next tick: a spawn costs up to a millisecond."""
    hello_s: float = 5.0
    """A connection that has not introduced itself by then is closed."""
    silence_s: float = 15.0
    """A client that has sent nothing for so long is closed."""
    stalled_s: float = 10.0
    """A client that could not be sent a snapshot for so long is closed."""
    messages_per_tick: float = 8.0
    """A client's messages beyond this rate (with a burst of 32 ticks' worth) close it."""
    first_bytes: int = 4 * 1024
    """So much may be on its way to a client of which nothing is known yet."""
    terrain_chunk_bytes: int = 1024
    """Terrain goes behind snapshots in pieces of this size,"""
    terrain_bytes_per_tick: int = 12 * 1024
    """at most so many bytes a tick."""
    commands_waiting_max: int = 64
    """A client's commands that wait for their tick; more are answered with `TOO_MANY`."""
    edits_per_s: float = 10.0
    """A client's edits beyond this rate (with a burst of two seconds' worth) are answered with `TOO_MANY`."""
    see_radius: int = 1
    """A client sees the segments at most so many segments away from its own,"""
    keep_radius: int = 2
    """and lets go of those further away than this."""

    def __post_init__(self) -> None:
        assert self.see_radius <= self.keep_radius
        assert self.terrain_chunk_bytes <= self.terrain_bytes_per_tick
