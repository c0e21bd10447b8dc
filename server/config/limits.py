"""All limits of the server, with their units.

A client that exceeds a limit is refused or closed with a code and a reason; its data is never queued without bound.
"""

from dataclasses import dataclass, fields

from server.config.options import Option, setting
from shared.bounds import in_ticks
from shared.checks import boolean, duration, whole
from shared.fields import CLIENT_MESSAGE_MAX, INPUT_ROWS_MAX, NAME_MAX

HOUR_S = 3600.0
"""Upper bound of the times that an operator can set, in seconds."""
MOST = 1 << 62
"""Upper bound of the whole numbers in `Limits` that are no settings."""
CATCH_UP_S, CATCH_UP_TICKS_MIN = 0.125, 4
"""Ticks that run at once after a pause: the ticks of this many seconds, but at least this many. Others are dropped."""


def catch_up_ticks(rate: int) -> int:
    """Returns the maximum number of ticks that run at once to catch up with the schedule.

    Args:
        rate: ticks per second.
    """
    return in_ticks(CATCH_UP_S, rate, CATCH_UP_TICKS_MIN)


@dataclass(frozen=True)
class Limits:
    """The limits per server and per client.

    Fields with a `Option` are settings: an operator sets them by flag, environment variable, or in the section `limits`
    of the file. `Limits(...)` accepts any non-negative value; the range of a `Option` holds for settings only.
    """

    connections_max: int = setting(
        4096,
        Option(
            int, "maximum connections, with or without a player; beyond it only pages are served", "N", 1, 1_000_000
        ),
    )
    connections_per_address: int = setting(
        64, Option(int, "maximum connections from one address (IPv6: from one /64 network)", "N", 1, 1_000_000)
    )
    joins_per_s: float = setting(
        200.0, Option(float, "maximum WebSockets opened per second; a burst may be those of 2 s", "N", 0.1, 100_000)
    )
    loopback_exempt: bool = setting(
        True, Option(bool, "do not limit connections from this machine per address and per second")
    )
    clients_max: int = setting(2000, Option(int, "maximum players at once", "N", 1, 1_000_000))
    handshake_s: float = setting(
        5.0, Option(float, "seconds in which a new connection must send its HTTP request", "S", 0.1, HOUR_S)
    )
    hello_s: float = setting(
        5.0, Option(float, "seconds in which a new WebSocket must send its hello", "S", 0.1, HOUR_S)
    )
    load_s: float = setting(
        10.0, Option(float, "seconds in which a game must load the data of a player who joins", "S", 0.1, HOUR_S)
    )
    silence_s: float = setting(
        15.0, Option(float, "seconds without a message after which a player's connection is closed", "S", 0.1, HOUR_S)
    )
    stalled_s: float = setting(
        10.0, Option(float, "seconds without room for a snapshot after which a connection is closed", "S", 0.1, HOUR_S)
    )
    resume_s: float = setting(
        15.0, Option(float, "seconds in which a player with a lost connection can reconnect", "S", 0.0, HOUR_S)
    )
    rewind_s: float = setting(0.5, Option(float, "seconds that lag compensation can look back", "S", 0.05, 1.0))
    message_bytes_max: int = setting(
        CLIENT_MESSAGE_MAX, Option(int, "maximum bytes of a client's message", "BYTES", 512, CLIENT_MESSAGE_MAX)
    )
    messages_per_tick: float = setting(
        8.0,
        Option(
            float,
            "maximum messages of a client per tick; a burst may be those of 1 s (at least 32 ticks)",
            "N",
            1,
            1000,
        ),
    )
    input_rows_max: int = setting(
        INPUT_ROWS_MAX, Option(int, "maximum inputs in one message; this SDK sends up to 16", "N", 16, INPUT_ROWS_MAX)
    )
    edits_per_s: float = setting(
        10.0, Option(float, "maximum edits of a player per second; a burst may be those of 2 s", "N", 0.5, 10_000)
    )
    commands_waiting_max: int = setting(
        64, Option(int, "maximum commands of a player that wait for their tick", "N", 1, 10_000)
    )
    name_max: int = setting(NAME_MAX, Option(int, "maximum characters of a player's name", "N", 1, NAME_MAX))
    worlds_max: int = setting(1000, Option(int, "maximum worlds at once, besides the default one", "N", 1, 100_000))
    creations_per_s: float = setting(
        20.0, Option(float, "maximum worlds that clients make per second; a burst may be those of 2 s", "N", 0.01, 1000)
    )
    asks_per_s: float = setting(
        2.0, Option(float, "maximum requests for a world per second and address; a burst may be 10 s", "N", 0.01, 1000)
    )
    seat_s: float = setting(
        30.0, Option(float, "seconds for which a seat in a world is reserved for a player", "S", 0.1, HOUR_S)
    )
    joins_per_tick: int = 8
    """Players that may join in one tick. Others wait for the next tick, because a spawn costs 1 to 2 ms."""
    outbox_max: int = 1024
    """Game events that may wait for one player. Beyond it the oldest are dropped, and the client is notified."""
    first_bytes: int = 4 * 1024
    """Bytes that may be on the way to a client before its first acknowledgement, when its bandwidth is unknown."""
    terrain_chunk_bytes: int = 1024
    """Bytes of one message of terrain, which is sent behind a snapshot."""
    terrain_bytes_per_tick: int = 12 * 1024
    """Bytes of terrain that may be sent to one client in one tick."""
    see_radius: int = 1
    """Distance from a client's own segment, in segments, up to which it is sent other segments."""
    keep_radius: int = 2
    """Distance from a client's own segment, in segments, beyond which segments are removed from its view."""

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
