"""Tables of plain values, as MessagePack holds them, of dataclasses."""

from collections.abc import Collection, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from shared.checks import SceneError

Made = TypeVar("Made")


def table_of(owner: Any, optional: Collection[str]) -> dict[str, Any]:
    """Returns the fields of a dataclass by name, but not None, nor a default of `optional`."""
    values = [(f, plain(getattr(owner, f.name))) for f in fields(owner)]
    return {
        f.name: value
        for f, value in values
        if value is not None and (f.name not in optional or value != plain(f.default))
    }


def plain(value: Any) -> Any:
    """Returns a value with lists in place of tuples, and tables in place of mappings and entries, at every depth."""
    if isinstance(value, Mapping):
        return {key: plain(value[key]) for key in value}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return plain(value.to_table()) if hasattr(value, "to_table") else value


def in_order(value: Any) -> Any:
    """Returns a value with the keys of tables in order, and whole numbers as floats: 18 and 18.0 are one number."""
    if isinstance(value, Mapping):
        return {key: in_order(value[key]) for key in sorted(value)}
    if isinstance(value, list):
        return [in_order(part) for part in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value


def made(of: type[Made], entry: object, at: str) -> Made:
    """Returns the part of a scene, a dataclass with a name, that an entry of its table describes.

    Args:
        of: the dataclass.
        entry: a table with the fields by name.
        at: name of the field that has `entry`, for the error.

    Raises:
        SceneError: `entry` is no table, a field is unknown or not valid, or the name is missing.
    """
    if not isinstance(entry, Mapping):
        raise SceneError(f"{at}: {entry!r} must be a table")
    known = {f.name for f in fields(of)}  # type: ignore[arg-type]
    for key in entry:
        if key not in known:
            raise SceneError(f"{at}.{key}: no such field (there are {', '.join(sorted(known))})")
    if "name" not in entry:
        raise SceneError(f"{at}.name: missing")
    return of(**entry)
