"""The addresses of worlds on a server: one that is asked for, or one with a name, a code or a reserved seat."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlencode, urlsplit

from shared import fields
from shared.checks import boolean, shown, text, whole

OWN = ("kind", "seats", "private", "code", "seat", "here")
"""Names of the query that are no properties."""
TEXT_MAX, WHOLE_MAX = 64, (1 << 53) - 1
"""Longest name or text of a property, and largest whole number in one."""


def matching(kind: str, seats: int, properties: Mapping[str, Any]) -> str:
    """Returns the path at which a server finds or makes a world.

    Args:
        kind: the kind of world.
        seats: number of seats to reserve, with the client's own.
        properties: the properties of the world.

    Raises:
        ValueError: an argument is not valid.
    """
    query = _query(kind, properties)
    if whole(seats, "seats", 1, fields.SEATS_MAX) > 1:
        query["seats"] = str(seats)
    return _short("/match?" + urlencode(query))


def creating(kind: str, private: bool, properties: Mapping[str, Any]) -> str:
    """Returns the path at which a server makes a world.

    Args:
        kind: the kind of world.
        private: whether only those with the world's code may join.
        properties: the properties of the world.

    Raises:
        ValueError: an argument is not valid.
    """
    query = _query(kind, properties)
    if boolean(private, "private"):
        query["private"] = "1"
    return _short("/create?" + urlencode(query))


def joining(code: str, seat: str, world: str) -> str:
    """Returns the path of a world.

    Args:
        code: the code of a private world.
        seat: the path of a reserved seat.
        world: the name of a world.

    Raises:
        ValueError: an argument is not valid, or it is not exactly one of the three.
    """
    given = {name: value for name, value in (("code", code), ("seat", seat), ("world", world)) if value != ""}
    if len(given) != 1:
        raise ValueError(f"{', '.join(given) or 'no argument'}: must be exactly one of code, seat and world")
    if code != "":
        return "/join?" + urlencode({"code": text(code, "code", fields.CODE_MAX)})
    if seat != "":
        if not fields.path(seat):
            raise ValueError(f"seat = {shown(seat)}: must be a path like /arena-1?seat=...")
        return seat
    path = "/" + text(world, "world", fields.PATH_MAX - 1)
    if not fields.path(path) or "?" in path or "/" in world:
        raise ValueError(f"world = {shown(world)}: must be the name of a world")
    return path


def at(url: str, path: str) -> str:
    """Returns the address of a path on the server of an address."""
    try:
        parts = urlsplit(url)
        return f"{parts.scheme}://{parts.netloc}{path}" if parts.netloc else url
    except (ValueError, TypeError, AttributeError):
        return url  # it is no address; the connection raises the error


def options_of(connect: Callable[..., Any], given: dict[str, Any]) -> dict[str, Any]:
    """Takes the arguments of `connect` out of all that were given, and returns them; properties are left."""
    names = inspect.signature(connect).parameters
    return {name: given.pop(name) for name in tuple(given) if name in names}


def _short(path: str) -> str:
    """Returns a path.

    Raises:
        ValueError: it is too long.
    """
    if len(path) > fields.PATH_MAX:
        raise ValueError(f"{path[:40]}...: a path of {len(path)} characters; at most {fields.PATH_MAX}")
    return path


def _query(kind: str, properties: Mapping[str, Any]) -> dict[str, str]:
    """Returns the query for a world of a kind, as texts.

    Raises:
        ValueError: the kind, or the name or the value of a property is not valid.
    """
    made = {"kind": text(kind, "kind", fields.NAME_MAX)}
    for name, value in properties.items():
        if name in OWN or len(name) > TEXT_MAX:
            raise ValueError(f"{name[: TEXT_MAX + 1]} = {shown(value)}: this name cannot be a property")
        if type(value) is bool:
            made[name] = "true" if value else "false"
        elif type(value) is int and abs(value) <= WHOLE_MAX:
            made[name] = str(value)
        elif isinstance(value, str):
            made[name] = text(value, name, TEXT_MAX, shortest=0)
        else:
            raise ValueError(f"{name} = {shown(value)}: a property must be a text, a whole number, True or False")
    return made
