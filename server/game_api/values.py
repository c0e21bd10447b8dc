"""Checks of the values that rules send to clients (attributes, shared values, events), and of tables of them."""

from collections.abc import Mapping
from typing import Any

import msgpack

from shared.checks import SceneError, text
from shared.fields import NAME_MAX
from shared.payloads import pack_value, unpack_value

ATTRIBUTES_MAX = 32
"""Maximum number of attributes of an entity, and of shared values of a game."""
VALUE_BYTES_MAX = 256
"""Maximum size of a value in MessagePack, in bytes."""

NOTHING = b"\xc0"
"""None, packed."""


def checked(name: str, value: Any) -> bytes:
    """Packs a value after checking it and its name.

    Raises:
        SceneError: the name is not a text of 1 to 32 characters, or the value is too long or no MessagePack value.
    """
    text(name, "name", NAME_MAX)
    try:
        payload = pack_value(value)
    except ValueError as error:
        raise SceneError(f"{name} = {error}") from error
    if len(payload) > VALUE_BYTES_MAX:
        raise SceneError(f"{name}: a value of {len(payload)} bytes; at most {VALUE_BYTES_MAX}")
    return payload


def packed(value: Any) -> bytes:
    """Packs a value that has been checked. Values that are equal in Python (1, True and 1.0) differ here."""
    return NOTHING if value is None else msgpack.packb(value)


def copied(value: Any) -> Any:
    """Returns a copy of a list or a table, so that a caller cannot change the original. Returns other values as is."""
    return unpack_value(packed(value)) if isinstance(value, list | dict) else value


def with_value(values: Mapping[str, Any], name: str, payload: bytes, owner: str) -> dict[str, Any]:
    """Returns a copy of a table in which a name has a new value. The value None removes the name.

    Args:
        values: the table.
        name: the name.
        payload: the new value, packed.
        owner: the entity, template or game that has the values, for the error.

    Raises:
        SceneError: the new table would have more than `ATTRIBUTES_MAX` values.
    """
    value = unpack_value(payload)
    after = {**values, name: value}
    if value is None:
        del after[name]
    if len(after) > ATTRIBUTES_MAX:
        raise SceneError(f"{owner}: more than {ATTRIBUTES_MAX} values")
    return after
