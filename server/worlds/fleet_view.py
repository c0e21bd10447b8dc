"""The view of a fleet that one process has: processes, worlds, and which process has what."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple, Protocol
from zlib import crc32

from server.worlds.fleet_entries import Figures, ProcessEntry, WorldEntry
from server.worlds.lease import LEASE_S, Lease, Request

DOUBT_S = 2.5
"""Seconds without a renewal after which no clients are sent to a process."""
GIVEN_S = 3.0
"""Seconds for which a world that was given to a process counts as its load, until it reports it itself."""


class Value(NamedTuple):
    """The value of a key, and its revision."""

    value: bytes
    revision: int


class Failed(NamedTuple):
    """A request without an answer (`refused` is false), or one that named another revision than the key's."""

    refused: bool


Result = int | Value | Failed | None
"""Result of a request: the new revision of a `put`, the value of a `get` or None, None of a `delete`, or a failure."""


class Seen(NamedTuple):
    """A process in the view, and the time in seconds at which its entry was seen to change."""

    entry: ProcessEntry
    revision: int
    changed_at: float


class Known(NamedTuple):
    """A world in the view."""

    entry: WorldEntry
    revision: int


class Mine:
    """A world of this process.

    Args:
        desired: what its entry is to have; None: the process does not know yet, because it takes the world over.
        written: what its entry has; None: it is not written.
        revision: revision of the entry.
        running: whether the world has begun.
    """

    def __init__(
        self, desired: WorldEntry | None, written: WorldEntry | None, revision: int, *, running: bool = False
    ) -> None:
        self.desired, self.written, self.revision, self.running = desired, written, revision, running
        self.ended = False
        """Whether the entry is to be removed."""


class Local(Protocol):
    """The worlds of this process, as the fleet sees them."""

    def report(self) -> tuple[bool, int, Mapping[str, int], Mapping[str, Figures]]:
        """Returns whether the process drains, its load, its room by kind, and the figures of its worlds."""
        ...

    def take(self, name: str, entry: WorldEntry, revision: int) -> None:
        """Makes the data of a world ready that was given to this process. It then calls `Fleet.ready`."""

    def begin(self, name: str, entry: WorldEntry) -> bool:
        """Begins a world of this process. Returns whether that was possible."""
        ...

    def lose(self, name: str) -> None:
        """Leaves a world that this process does not own any more, and writes nothing."""


class FleetView:
    """The view of one process.

    Args:
        name: name of the fleet.
        url: address of this process for clients.
        local: its worlds.
        lease: its lease.
    """

    def __init__(self, name: str, url: str, local: Local, lease: Lease) -> None:
        self.prefix, self.url = f"fleet.{name}.", url
        self._local, self._lease = local, lease
        self.now = 0.0
        self.processes: dict[str, Seen] = {}
        """Other processes by identifier."""
        self.worlds: dict[str, Known] = {}
        """All worlds by name."""
        self.mine: dict[str, Mine] = {}
        """Worlds of this process by name."""
        self._open: dict[str, Request] = {}
        self._placing: dict[str, WorldEntry] = {}
        self._given: dict[str, tuple[float, str, str]] = {}

    @property
    def me(self) -> str:
        """Identifier of this process."""
        return self._lease.me

    def holds(self, now: float) -> bool:
        """Returns whether this process has its lease. May be called from any thread."""
        return self._lease.holds(now)

    def owns(self, name: str, now: float) -> bool:
        """Returns whether this process may change a world now."""
        mine = self.mine.get(name)
        return mine is not None and mine.written is not None and mine.written.owner == self.me and self.holds(now)

    def alive(self, process: str) -> bool:
        """Returns whether a process has a lease."""
        if process == self.me:
            return self.holds(self.now)
        seen = self.processes.get(process)
        return seen is not None and self.now - seen.changed_at < LEASE_S

    def fresh(self, process: str) -> bool:
        """Returns whether a process has renewed its lease lately, so that clients may be sent there."""
        seen = self.processes.get(process)
        return process == self.me or (seen is not None and self.now - seen.changed_at < DOUBT_S)

    def others(self) -> Iterator[tuple[str, ProcessEntry]]:
        """Yields the other processes that have a lease."""
        for process, seen in self.processes.items():
            if self.alive(process):
                yield process, seen.entry

    def address(self, process: str) -> str:
        """Returns the address of a process."""
        return self.url if process == self.me else self.processes[process].entry.url

    def taken(self, name: str) -> bool:
        """Returns whether a name is in use, as far as this process knows."""
        return name in self.worlds or name in self.mine or name in self._placing

    def owner(self, name: str) -> str:
        """Returns the process that has a world and lives; empty: none, or there is no such world."""
        if name in self.mine:
            return self.me
        if name in self._placing:
            target = self._placing[name].owner
            return target if self.alive(target) else ""
        known = self.worlds.get(name)
        return known.entry.owner if known is not None and self.alive(known.entry.owner) else ""

    def entry(self, name: str) -> WorldEntry | None:
        """Returns the entry of a world that other processes know, or will know soon."""
        known = self.worlds.get(name)
        return self._placing.get(name) if known is None else known.entry

    def figures(self, process: str, name: str) -> Figures | None:
        """Returns the figures of a world of another process; None: there are none yet."""
        seen = self.processes.get(process)
        return None if seen is None else seen.entry.worlds.get(name)

    def of_kind(self, kind: str) -> list[str]:
        """Returns the names of all worlds of a kind."""
        entries = [(name, known.entry) for name, known in self.worlds.items()] + [*self._placing.items()]
        return list(dict.fromkeys(name for name, entry in entries if entry.kind == kind))

    def coded(self, code: str) -> str:
        """Returns the name of the world with a code; empty: there is none."""
        entries = [(name, known.entry) for name, known in self.worlds.items()] + [*self._placing.items()]
        return next((name for name, entry in entries if code and entry.code == code), "")

    def asking(self, name: str) -> bool:
        """Returns whether the bus has been asked for a world and has not answered yet."""
        return self._world_key(name) in self._open

    def place(self, kind: str) -> str:
        """Returns the process with the least load that has room for a world of a kind; empty: none."""
        self._given = {name: given for name, given in self._given.items() if given[0] > self.now}
        draining, load, room, _ = self._local.report()
        found = [(load, 0, self.me)] if not draining and room.get(kind, 0) > 0 and self.holds(self.now) else []
        for process, entry in filter(lambda other: self.fresh(other[0]), self.others()):
            given = [kind for name, (_, to, kind) in self._given.items() if to == process and name not in entry.worlds]
            if not entry.draining and entry.room.get(kind, 0) > given.count(kind):
                found.append((entry.load + 2 * len(given), 1, process))
        return min(found)[2] if found else ""

    def matchmaker(self, kind: str) -> str:
        """Returns the process that matches the clients of a kind, the same one at every process; empty: none."""
        draining, _, room, _ = self._local.report()
        found = [self.me] if not draining and kind in room and self.holds(self.now) else []
        for process, entry in self.others():
            if not entry.draining and kind in entry.room and self.fresh(process):
                found.append(process)
        return min(found, key=lambda process: crc32(f"{kind} {process}".encode()), default="")

    def _process_key(self, process: str) -> str:
        return f"{self.prefix}process.{process}"

    def _world_key(self, name: str) -> str:
        return f"{self.prefix}world.{name}"
