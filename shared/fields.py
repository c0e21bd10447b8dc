"""The fields of messages: their limits, and the checks of their values.

A check returns whether a value that a peer sent is of the right type and within its limits. Types are compared with
`type(value) is`, because a bool is an `int` for `isinstance`.
"""

import math
import re
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from shared.bounds import STATUSES_S, TICK_RATE_MAX, in_ticks

MESSAGE_MAX = 256 * 1024
"""Longest message of a server, in bytes."""
CLIENT_MESSAGE_MAX = 8 * 1024
"""Longest message of a client, in bytes."""
INPUT_ROWS_MAX = 64
"""Limit of the inputs in one message."""
INPUT_ROW_BYTES = 3
"""Length of one input in `Inputs.rows`, in bytes."""
AIM_ROW_BYTES = 9
"""Length of one input in `Inputs.rows` in a scene with aim, in bytes."""
NAME_MAX = 32
"""Longest name of a player, a command or a game event, in characters."""
SCENE_FIELDS_MAX = 32
"""Limit of the scene's fields in `Hello.scene`."""
REASON_MAX = 500
"""Longest reason in a `Bye` or a `Refusal`, in characters."""
STATUSES_MAX = in_ticks(STATUSES_S, TICK_RATE_MAX, 1)
"""Limit of the margins, and of the input statuses, in one snapshot."""
DROPS_MAX = 4096
"""Limit of the dropped segments in one snapshot."""
VERDICTS_MAX = 128
"""Limit of the verdicts in one snapshot."""
COMMAND_MAX = (1 << 32) - 1
"""Greatest number of a command."""
PAYLOAD_MAX = 1024
"""Longest payload of a command or a game event, in bytes."""
PACKED_MAX = 48 * 1024
"""Longest packed segment, in bytes (random blocks of 256 kinds pack to 33 KB)."""
SEGMENTS_MAX = 1024
"""Limit of the segments in one snapshot."""
TOKEN_MAX = 2048
"""Longest token, in characters."""
PATH_MAX = 1024
"""Longest path of a world on its server, with a reserved seat, in characters."""
CODE_MAX = 16
"""Longest code of a private world, in characters."""
SEATS_MAX = 64
"""Limit of the seats that one client reserves."""
ADDRESS_MAX = 256
"""Longest address of a server, in characters."""
EDGES_MAX = 64
"""Limit of the addresses in one message."""
RESUME_BYTES = 16
"""Length of a resume token, in bytes."""
LIST_MAX = 8 * 1024
"""Limit of the items of a list in a message of the server. A MessagePack decoder reserves memory for the length that a
list claims, so the length of the message alone is no bound."""
CLIENT_LIST_MAX = 8
"""Limit of the items of a list in a message of a client."""
TABLE_MAX = 64
"""Limit of the items of a table in any message."""
TICK_MAX = (1 << 53) - 1
"""Greatest tick in a message."""
FIRST_MAX = TICK_MAX - INPUT_ROWS_MAX
"""Greatest first tick of an `Inputs` message."""
AFTER_MAX = INPUT_ROWS_MAX
"""Limit of the ticks between a `Held` and the message with inputs before it."""
ENTITY_MAX = (1 << 31) - 1
"""Greatest number of an entity."""

_PATH = re.compile(r"[!-~]+")
_ADDRESS = re.compile(r"wss?://(?:[A-Za-z0-9.-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{1,5})?")

Check = Callable[[Any], bool]
"""Function that returns whether a value is allowed in a field."""


def _whole(low: int, high: int) -> Check:
    return lambda value: type(value) is int and low <= value <= high


def _bytes(longest: int, of: int = 1) -> Check:
    return lambda value: type(value) is bytes and len(value) <= longest and len(value) % of == 0


def _text(longest: int) -> Check:
    return lambda value: type(value) is str and len(value) <= longest


version, code, count, entity = _whole(0, 1 << 31), _whole(0, 4999), _whole(0, COMMAND_MAX), _whole(1, ENTITY_MAX)
"""Checks: version of the protocol, close code, number of a command (or another count), number of an entity."""
tick, first, index = _whole(-1, TICK_MAX), _whole(0, FIRST_MAX), _whole(0, TICK_MAX)
"""Checks: tick (-1: none), first tick of inputs, number of a game event."""
after = _whole(1, AFTER_MAX)
"""Check of the number of ticks from one message with inputs to the next."""
segment, offset, total = _whole(-(1 << 23), (1 << 23) - 1), _whole(0, PACKED_MAX), _whole(1, PACKED_MAX)
"""Checks: index of a segment along an axis, place within a packed segment, length of a packed segment."""
name, token, reason = _text(NAME_MAX), _text(TOKEN_MAX), _text(REASON_MAX)
"""Checks: name, identity token, reason in a `Bye`, a `Refusal` or a `Go`."""
world_code = _text(CODE_MAX)
"""Check of the code of a private world; empty: none."""
rows = _bytes(INPUT_ROWS_MAX * AIM_ROW_BYTES, INPUT_ROW_BYTES)
"""Check of packed inputs, for scenes with and without aim; `whole_rows` checks the rest."""
payload, chunk = _bytes(PAYLOAD_MAX), _bytes(PACKED_MAX)
"""Checks: payload, piece of a packed segment."""
margins, statuses = _bytes(STATUSES_MAX * 2, 2), _bytes(STATUSES_MAX)
"""Checks: packed arrival margins and input statuses."""
verdicts, drops = _bytes(VERDICTS_MAX * 5, 5), _bytes(DROPS_MAX * 12, 12)
"""Checks: packed verdicts and dropped segments."""


def whole_rows(rows: bytes, row_bytes: int) -> bool:
    """Returns whether packed inputs are at most `INPUT_ROWS_MAX` inputs of `row_bytes` bytes each."""
    return len(rows) <= INPUT_ROWS_MAX * row_bytes and len(rows) % row_bytes == 0


def number(value: Any) -> bool:
    """Returns whether a value is a finite number."""
    return type(value) in (int, float) and math.isfinite(value)


def table(value: Any) -> bool:
    """Returns whether a value is a table."""
    return type(value) is dict


def names(value: Any) -> bool:
    """Returns whether a value is a table whose keys are texts."""
    return type(value) is dict and all(type(name) is str for name in value)


def path(value: Any) -> bool:
    """Returns whether a value is a path with a query, as it stands in an HTTP request."""
    return type(value) is str and len(value) <= PATH_MAX and value[:1] == "/" and _PATH.fullmatch(value) is not None


def address(value: Any) -> bool:
    """Returns whether a value is the address of a server, without a path: ws://HOST:PORT."""
    return type(value) is str and len(value) <= ADDRESS_MAX and _ADDRESS.fullmatch(value) is not None and _splits(value)


def addresses(value: Any) -> bool:
    """Returns whether a value is a list of addresses of servers."""
    return type(value) is list and len(value) <= EDGES_MAX and all(map(address, value))


def place(value: Any) -> bool:
    """Returns whether a value is a path on this server, or the address of a server with a path."""
    if type(value) is not str or value[:1] == "/":
        return path(value)
    server, rest = split_place(value[: ADDRESS_MAX + PATH_MAX])
    return address(server) and path(rest)


def split_place(place: str) -> tuple[str, str]:
    """Returns the address of a server, empty if it is this one, and the path of a place."""
    if place[:1] == "/":
        return "", place
    scheme, _, rest = place.partition("://")
    host, slash, path = rest.partition("/")
    return f"{scheme}://{host}", slash + path


def _splits(address: str) -> bool:
    """Returns whether host and port of an address can be used."""
    try:
        parts = urlsplit(address)
        return bool(parts.hostname) and parts.port != 0
    except ValueError:
        return False


def paths(value: Any) -> bool:
    """Returns whether a value is a list of paths of worlds."""
    return type(value) is list and len(value) <= SEATS_MAX and all(map(path, value))


def resume(value: Any) -> bool:
    """Returns whether a value is a resume token, or empty."""
    return type(value) is bytes and len(value) in (0, RESUME_BYTES)


def digests(value: Any) -> bool:
    """Returns whether a value is a table of a scene's digests by field."""
    return (
        type(value) is dict
        and len(value) <= SCENE_FIELDS_MAX
        and all(type(name) is str and type(digest) is bytes and len(digest) <= 8 for name, digest in value.items())
    )


def shown(value: Any) -> str:
    """Returns a peer's value for the text of an error: short, and only the type of a list or table.

    A list may be nested a thousand levels deep, so `repr` is not safe.
    """
    return type(value).__name__ if isinstance(value, list | dict) else str(value)[:40]
