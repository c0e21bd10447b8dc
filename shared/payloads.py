"""Payloads: values of a game in MessagePack, in commands and in game events."""

from typing import Any

import msgpack

from shared import checks
from shared.fields import PAYLOAD_MAX, TABLE_MAX
from shared.messages import ProtocolError


def pack_value(value: Any) -> bytes:
    """Returns a value packed as the payload of a command or of `Happened`.

    Raises:
        ValueError: MessagePack cannot hold the value, or it is longer than `PAYLOAD_MAX` bytes.
    """
    try:
        payload: bytes = msgpack.packb(value)
        unpack_value(payload)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{checks.shown(value)}: {_unpackable(error)}") from error
    if len(payload) > PAYLOAD_MAX:
        raise ValueError(f"a value of {len(payload)} bytes: longer than {PAYLOAD_MAX}")
    return payload


def _unpackable(error: Exception) -> str:
    """Returns the reason why a value cannot be packed."""
    if isinstance(error, UnicodeEncodeError):
        return f"it has a text that UTF-8 cannot hold: {checks.shown(error.object)}"
    return f"not a MessagePack value ({' '.join(str(error).split())[:80]})"


def unpack_value(payload: bytes) -> Any:
    """Returns the value in a payload that `pack_value` made.

    Raises:
        ProtocolError: the bytes are not MessagePack.
    """
    try:
        return msgpack.unpackb(payload, max_array_len=PAYLOAD_MAX, max_map_len=TABLE_MAX)
    except Exception as error:  # msgpack raises about ten types of exceptions for such bytes
        raise ProtocolError(f"payload: not MessagePack ({type(error).__name__})") from error
