"""The list of the public worlds of a server, which it serves over HTTP."""

import json
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from client_sdk.transports.common import ConnectError
from shared.checks import duration, shown

if TYPE_CHECKING:
    import http.client
    import ssl

LIST_BYTES_MAX = 16 * 1024 * 1024
"""Limit of the list, in bytes."""
READ_BYTES = 64 * 1024
"""Number of bytes that are read at once."""


@dataclass(frozen=True)
class WorldEntry:
    """One world in the list of a server's worlds.

    `players` is the number of players of `players_max`. `locked` and `full` say that only players with a reserved seat
    may join. `properties` are texts, whole numbers and truth values. `age_s` is the time since the world was made, in
    seconds.
    """

    name: str
    kind: str
    players: int
    players_max: int
    locked: bool
    full: bool
    properties: dict[str, str | int | bool]
    age_s: float


FIELDS: dict[str, tuple[type, ...]] = {
    "name": (str,), "kind": (str,), "players": (int,), "players_max": (int,), "locked": (bool,), "full": (bool,),
    "properties": (dict,), "age_s": (int, float),
}  # fmt: skip
"""Types of the fields of an entry."""


def list_worlds(
    url: str, kind: str | None = None, timeout: float = 5.0, *, tls: "ssl.SSLContext | None" = None
) -> list[WorldEntry]:
    """Returns the public worlds of a server, in the order in which they were made. Blocks until the server answers.

    Args:
        url: address of the server, like ws://localhost:8765.
        kind: the kind of the worlds; None: all kinds.
        timeout: the longest time to wait, in seconds.
        tls: certificates to trust for wss://; None: those that the system trusts.

    Raises:
        ValueError: an argument is not valid.
        ConnectError: the server cannot be reached, or has no list of worlds.
    """
    import http.client  # here, because few programs need it, and it takes some ms

    from client_sdk.transports.connection import checked_tls, parsed

    uri, tls = parsed(url), checked_tls(tls)
    until = time.monotonic() + duration(timeout, "timeout")
    if kind is not None and not isinstance(kind, str):
        raise ValueError(f"kind = {shown(kind)}: must be a text, or None for all kinds")
    connection = (
        http.client.HTTPSConnection(uri.host, uri.port, timeout=timeout, context=tls)
        if uri.secure
        else http.client.HTTPConnection(uri.host, uri.port, timeout=timeout)
    )
    try:
        connection.request("GET", "/worlds")
        response = connection.getresponse()
        body = _body(response, until)
    except (OSError, http.client.HTTPException) as error:
        raise ConnectError(f"{url}: no list of worlds ({str(error) or type(error).__name__})") from error
    finally:
        connection.close()
    if response.status != 200:
        why = body.decode(errors="replace").strip()[:200]
        raise ConnectError(f"{url}: no list of worlds (HTTP status {response.status}{': ' if why else ''}{why})")
    entries = _entries(url, body)
    return [entry for entry in entries if kind in (None, entry.kind)]


def _body(response: "http.client.HTTPResponse", until: float) -> bytes:
    """Returns the body of an answer.

    Raises:
        OSError: it is too long, or does not arrive in time.
    """
    body = bytearray()
    while chunk := response.read1(READ_BYTES):
        body += chunk
        if len(body) > LIST_BYTES_MAX:
            raise OSError(f"more than {LIST_BYTES_MAX >> 20} MiB")
        if time.monotonic() > until:
            raise TimeoutError("no answer in time")
    return bytes(body)


def _entries(url: str, body: bytes) -> list[WorldEntry]:
    """Returns the entries of a list.

    Raises:
        ConnectError: the list is malformed.
    """
    try:
        table = json.loads(body)
    except (ValueError, RecursionError):
        table = None
    listed = table.get("worlds") if isinstance(table, dict) else None
    if not isinstance(listed, list) or not all(map(_good, listed)):
        raise ConnectError(f"{url}: no list of worlds (its answer is something else)")
    return [WorldEntry(**{name: entry[name] for name in FIELDS}) for entry in listed]


def _good(entry: Any) -> bool:
    """Returns whether an entry has all fields, each of the right type."""
    return isinstance(entry, dict) and all(type(entry.get(name)) in types for name, types in FIELDS.items())
