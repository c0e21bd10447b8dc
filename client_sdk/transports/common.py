"""The common part of all transports: the error of a connection, its limits, and how long a server may be silent."""

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from client_sdk.travel import Travel

UNSENT_MAX = 64 * 1024
"""Limit of the bytes that wait for a server that does not read: about 90 s of 32 inputs per second. Beyond it, the
client gives the connection up."""
SILENCE_S = 10.0
"""Time without any bytes from the server after which the connection counts as lost, in seconds. TCP alone may take 15
minutes to report a server that is gone."""
ELSEWHERE_SILENCE_S = 2.0
"""Time without any bytes after which the connection counts as lost if there are other servers of the same world, in
seconds. A server that lives answers a ping per second."""
ELSEWHERE_TIMEOUT_S = 1.5
"""Time that a handshake with another server of the same world may take, in seconds; then the client tries the next."""
LOOK_S = 1.0
"""Longest time between two looks that counts as silence, in seconds: a program that was busy or asleep could not
receive anything."""
TIMEOUT_S = 5.0
"""Time that a handshake may take, in seconds."""
CLOSE_S = 2.0
"""Time that a server gets to finish the closing handshake, in seconds; then the client closes the stream anyway."""
REASON_BYTES_MAX = 123
"""Room for the reason in a close frame, in bytes (RFC 6455)."""
BROKE_OFF = 1006
"""Close code of a connection that broke off (RFC 6455)."""
ADDRESS_HINT = "a server's address looks like ws://localhost:8765"


class ConnectError(ConnectionError):
    """The client could not connect; the text says why, and what to do.

    `wait_s` is the time after which the server asks to try again, in seconds; negative if it does not ask.
    """

    def __init__(self, text: str, wait_s: float = -1.0) -> None:
        super().__init__(text)
        self.wait_s = wait_s


class Silence:
    """The time for which a server has been silent."""

    def __init__(self) -> None:
        self._looked = math.inf
        self._silent_s = 0.0

    def heard(self) -> None:
        """Notes that something has arrived, or that the server need not send anything."""
        self._silent_s = 0.0

    def look(self, now: float, limit_s: float = SILENCE_S) -> bool:
        """Returns whether the server was silent for more than a limit in seconds. Call it at least once per second."""
        self._silent_s += min(max(now - self._looked, 0.0), LOOK_S)
        self._looked = now
        return self._silent_s > limit_s


def silence_s(travel: "Travel") -> float:
    """Returns the time without any bytes after which a connection counts as lost, in seconds."""
    return ELSEWHERE_SILENCE_S if travel.edges and not travel.fronts else SILENCE_S


def timeout_s(travel: "Travel", longest_s: float) -> float:
    """Returns the time that the next handshake may take, in seconds.

    Args:
        travel: the way of the client.
        longest_s: the time if there is no other server to try.
    """
    return min(ELSEWHERE_TIMEOUT_S, longest_s) if travel.fresh else longest_s


def sendable(reason: str) -> str:
    """Returns a reason as far as it fits into a close frame."""
    return reason.encode()[:REASON_BYTES_MAX].decode(errors="ignore")
