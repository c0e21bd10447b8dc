"""The entries of a fleet in the keys of a bus: processes and worlds, as JSON.

    fleet.NAME.process.ID     one process: its lease, its load, and the figures of its worlds; it writes this itself
    fleet.NAME.world.WORLD    one world: its owner, and what another process needs to begin it again

Everything that comes from the bus is checked here. An entry that cannot be used is an `EntryError`.
"""

import json
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from server.players.ticket import Property
from server.worlds.kinds import WorldsError, checked_properties
from shared import fields

ENTRY_BYTES_MAX = 1 << 20
"""Longest value of a key, in bytes."""
WORLDS_MAX = 100_000
"""Maximum number of worlds in the entry of a process, and of worlds and processes in a fleet."""
TAKEN_MAX = 256
"""Maximum number of seats in the figures of a world."""
COUNT_MAX = 1 << 40
"""Largest number in an entry."""
ID = re.compile("[a-z0-9]{4,16}")
"""Pattern of the identifier of a process."""
NAME = re.compile("[a-z][a-z0-9-]{0,47}")
"""Pattern of the name of a world or a kind in a fleet."""
FOLDER = re.compile("[a-z][a-z0-9-]{0,47}(@[0-9]{1,19})?")
"""Pattern of the name of a directory with the data of a world."""
CODE = re.compile("[A-Z0-9]{0,16}")
"""Pattern of the code of a private world."""
SHORT = re.compile("[A-Za-z0-9_-]{1,32}")
"""Pattern of the number of a seat, and of the secret of a process."""


class EntryError(ValueError):
    """A value of a key that is no entry."""


class Figures(NamedTuple):
    """The figures of a world, from its owner.

    `free` is the number of seats that are neither taken nor reserved. `taken` has the numbers of seats from other
    processes that were taken lately.
    """

    players: int
    free: int
    locked: bool
    age_s: float
    properties: Mapping[str, Property]
    taken: tuple[str, ...] = ()


class ProcessEntry(NamedTuple):
    """A process: its lease and its load.

    `nonce` is a secret of this process, `beat` counts its renewals. `url` is its address for clients. `room` has the
    number of further worlds that it can hold, by kind.
    """

    nonce: str
    beat: int
    url: str
    draining: bool
    load: int
    room: Mapping[str, int]
    worlds: Mapping[str, Figures]


class WorldEntry(NamedTuple):
    """A world. `owner` is a process; empty: none has it.

    `folder` has its data; empty: it is not saved. `clean` says that no process has the data open. A world that is
    `asleep` begins when a player comes; one that `stays` does not end when it is empty.
    """

    owner: str
    kind: str
    properties: Mapping[str, Property]
    code: str = ""
    folder: str = ""
    clean: bool = False
    asleep: bool = False
    stays: bool = False


def packed(entry: ProcessEntry | WorldEntry) -> bytes:
    """Returns the value of a key for an entry."""
    table = entry._asdict()
    if isinstance(entry, ProcessEntry):
        table["worlds"] = {name: list(figures) for name, figures in entry.worlds.items()}
    return json.dumps(table, separators=(",", ":")).encode()


def process_of(value: bytes) -> ProcessEntry:
    """Returns the entry of a process.

    Raises:
        EntryError: the value is none.
    """
    table = _table(value, ProcessEntry._fields)
    entry = ProcessEntry(**table)
    _check(_matches(SHORT, entry.nonce), "nonce")
    _check(_count(entry.beat) and _count(entry.load), "beat, load")
    _check(fields.address(entry.url), "url")
    _check(type(entry.draining) is bool, "draining")
    _check(_tables(entry.room) and all(NAME.fullmatch(name) and _count(n) for name, n in entry.room.items()), "room")
    _check(_tables(entry.worlds) and len(entry.worlds) <= WORLDS_MAX, "worlds")
    return entry._replace(worlds={name: _figures(name, row) for name, row in entry.worlds.items()})


def world_of(value: bytes) -> WorldEntry:
    """Returns the entry of a world.

    Raises:
        EntryError: the value is none.
    """
    entry = WorldEntry(**_table(value, WorldEntry._fields))
    _check(entry.owner == "" or _matches(ID, entry.owner), "owner")
    _check(_matches(NAME, entry.kind), "kind")
    _check(entry.folder == "" or _matches(FOLDER, entry.folder), "folder")
    _check(_matches(CODE, entry.code), "code")
    _check(all(type(flag) is bool for flag in (entry.clean, entry.asleep, entry.stays)), "clean, asleep, stays")
    return entry._replace(properties=_properties(entry.properties))


def _figures(name: str, row: Any) -> Figures:
    _check(_matches(NAME, name) and isinstance(row, list) and len(row) == len(Figures._fields), "worlds")
    figures = Figures(*row)
    _check(_count(figures.players) and (_count(figures.free) or _count(-_number(figures.free))), "players, free")
    _check(type(figures.locked) is bool, "locked")
    _check(type(figures.age_s) in (int, float) and 0 <= figures.age_s <= COUNT_MAX, "age_s")
    taken = figures.taken
    _check(isinstance(taken, list) and len(taken) <= TAKEN_MAX and all(_matches(SHORT, one) for one in taken), "taken")
    return figures._replace(properties=_properties(figures.properties), taken=tuple(taken))


def _table(value: bytes, names: tuple[str, ...]) -> dict[str, Any]:
    """Returns the fields of an entry; fields of later versions are left out."""
    _check(len(value) <= ENTRY_BYTES_MAX, "size")
    try:
        table = json.loads(value)
    except (ValueError, RecursionError) as error:
        raise EntryError("no JSON") from error
    _check(isinstance(table, dict) and all(name in table for name in names), "fields")
    return {name: table[name] for name in names}


def _properties(value: Any) -> dict[str, Property]:
    _check(_tables(value), "properties")
    try:
        return checked_properties(value)
    except WorldsError as error:
        raise EntryError(str(error)) from error


def _tables(value: Any) -> bool:
    return isinstance(value, dict)


def _matches(pattern: re.Pattern[str], value: Any) -> bool:
    return isinstance(value, str) and pattern.fullmatch(value) is not None


def _count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= COUNT_MAX


def _number(value: Any) -> int:
    return value if type(value) is int else 1


def _check(good: bool, what: str) -> None:
    if not good:
        raise EntryError(f"{what}: not valid")
