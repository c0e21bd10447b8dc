"""Every bound of the server, with its unit; what is reached is answered with a close code, never with a queue."""

from dataclasses import dataclass, fields

from server.kinds import Kind, setting
from shared.bounds import in_ticks
from shared.checks import boolean, duration, whole
from shared.messages import CLIENT_MESSAGE_MAX, INPUT_ROWS_MAX, NAME_MAX

HOUR_S = 3600.0
MOST = 1 << 62
CATCH_UP_S, CATCH_UP_TICKS_MIN = 0.125, 4
"""After a pause, at most this many seconds' worth of ticks (at least this many) run at once; the rest is dropped."""


def catch_up_ticks(rate: int) -> int:
    """Returns the most ticks that run in a row to catch up with the schedule."""
    return in_ticks(CATCH_UP_S, rate, CATCH_UP_TICKS_MIN)


@dataclass(frozen=True)
class Limits:
    """Bounds per server and per client. Those with a `Kind` are settings (section `limits` of the file)."""

    connections_max: int = setting(
        4096, Kind(int, "connections at a time, players or not; pages answer beyond it", "N", 1, 1_000_000)
    )
    connections_per_address: int = setting(
        64, Kind(int, "connections at a time from one address (IPv6: one /64 network)", "N", 1, 1_000_000)
    )
    joins_per_s: float = setting(
        200.0, Kind(float, "WebSockets opened per second, with a burst of two seconds' worth", "N", 0.1, 100_000)
    )
    loopback_exempt: bool = setting(
        True, Kind(bool, "connections from this machine are not limited per address and per second")
    )
    clients_max: int = setting(2000, Kind(int, "players at a time", "N", 1, 1_000_000))
    handshake_s: float = setting(5.0, Kind(float, "a connection must have sent its request by then", "S", 0.1, HOUR_S))
    hello_s: float = setting(5.0, Kind(float, "a WebSocket must have joined by then", "S", 0.1, HOUR_S))
    silence_s: float = setting(15.0, Kind(float, "a player heard nothing of for so long is closed", "S", 0.1, HOUR_S))
    stalled_s: float = setting(
        10.0, Kind(float, "a player that took no snapshot for so long is closed", "S", 0.1, HOUR_S)
    )
    resume_s: float = setting(
        15.0, Kind(float, "a player whose connection is lost keeps the entity for so long", "S", 0.0, HOUR_S)
    )
    rewind_s: float = setting(
        0.5, Kind(float, "how far back the rules may look for a shot (lag compensation)", "S", 0.05, 1.0)
    )
    message_bytes_max: int = setting(
        CLIENT_MESSAGE_MAX, Kind(int, "longest message of a client, in bytes", "BYTES", 512, CLIENT_MESSAGE_MAX)
    )
    messages_per_tick: float = setting(
        8.0, Kind(float, "messages of a client per tick, with a burst of 32 ticks' worth", "N", 1, 1000)
    )
    input_rows_max: int = setting(
        INPUT_ROWS_MAX, Kind(int, "inputs in one message; this SDK sends up to sixteen", "N", 16, INPUT_ROWS_MAX)
    )
    edits_per_s: float = setting(
        10.0, Kind(float, "edits of a player per second, with a burst of two seconds' worth", "N", 0.5, 10_000)
    )
    commands_waiting_max: int = setting(64, Kind(int, "commands of a player that wait for their tick", "N", 1, 10_000))
    name_max: int = setting(NAME_MAX, Kind(int, "longest name of a player, in characters", "N", 1, NAME_MAX))
    joins_per_tick: int = 8
    """More wait for the next tick: a spawn costs a millisecond or two."""
    outbox_max: int = 1024
    """Events of the rules that wait for one player; of more, the oldest are dropped, and the client is told."""
    first_bytes: int = 4 * 1024
    """So much may be on its way to a client of which nothing is known yet."""
    terrain_chunk_bytes: int = 1024
    """Terrain goes behind snapshots in pieces of this size,"""
    terrain_bytes_per_tick: int = 12 * 1024
    """at most so many bytes a tick."""
    see_radius: int = 1
    """A client sees the segments at most so many segments away from its own,"""
    keep_radius: int = 2
    """and lets go of those further away than this."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value, default = getattr(self, f.name), f.default
            if isinstance(default, bool):
                boolean(value, f.name)
            elif isinstance(default, int):
                whole(value, f.name, 0, MOST)
            else:
                duration(value, f.name, endless=True)
        assert self.see_radius <= self.keep_radius
        assert self.terrain_chunk_bytes <= self.terrain_bytes_per_tick
