"""The worlds of one process of a fleet: its own, and the way to those of the others.

Theory of operation. A client may ask any process. One process matches all clients of a kind (`Fleet.matchmaker`), so
that two who come at the same time at different processes meet; the others send their clients there. It finds a world
anywhere, or has one made at the process with the least load, and reserves the seats by signed tokens. A client that
asks for a world of another process by its name is sent there, too. If the world's process is gone, the client waits in
the lobby until another one has the world.
"""

import logging
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from server.players.ticket import Property
from server.worlds.directory import STOPPING
from server.worlds.fleet import Fleet
from server.worlds.fleet_entries import TAKEN_MAX, Figures, WorldEntry
from server.worlds.fleet_matchmaking import FleetMatchmaking, Wanted
from server.worlds.host import Host, Way
from server.worlds.hosted import HostedWorld
from server.worlds.kinds import Kind, WorldsError, checked_name, checked_properties
from server.worlds.lobby import VERBS
from server.worlds.remote import RemoteWorld
from server.worlds.worlds import Worlds, name_in
from shared import fields, messages
from shared.messages import Go

AWAY_S = 0.5
"""Wait of clients whose world goes on at another process, in seconds."""

logger = logging.getLogger(__name__)


class FleetHost(Host, Protocol):
    """The surroundings of the worlds of a process of a fleet."""

    def folder(self, name: str) -> str:
        """Returns the directory with the data of a world that has begun; empty: it is not saved."""
        ...

    def take(self, name: str, folder: str, number: int, done: Callable[[str | None], None]) -> None:
        """Copies the data of a world whose process is gone, so that nothing that it writes any more counts.

        Args:
            name: name of the world.
            folder: the directory; empty: the world is new.
            number: a number that no other copy has.
            done: called with the name of the new directory; empty: worlds are not saved; None: it cannot be made.
        """

    def locate(self, name: str, folder: str) -> None:
        """Sets the directory of a world that is about to begin, and removes former ones."""

    def left(self, world: HostedWorld) -> None:
        """Takes the end of a world that goes on at another process. Nothing more is written."""

    def closed(self, name: str, done: Callable[[], None]) -> None:
        """Calls a function once the files of a world that has ended are closed."""


class FleetWorlds(Worlds):
    """The worlds of one process of a fleet. Arguments as for `Worlds`; call `join` before anything else."""

    fleet: Fleet
    matchmaking: FleetMatchmaking
    matchmaking_of = FleetMatchmaking

    @property
    def alone(self) -> bool:  # type: ignore[override]
        """Whether no other process can take the clients of this one."""
        return not any(not entry.draining for _, entry in self.fleet.others())

    def join(
        self,
        name: str,
        url: str,
        host: FleetHost,
        *,
        key: bytes,
        clock: Callable[[], float],
        wall: Callable[[], float],
        token: Callable[[], str],
    ) -> None:
        """Joins a fleet.

        Args:
            name: name of the fleet.
            url: address of this process for clients.
            host: the host of the worlds.
            key: the key of the seats, which all processes share.
            clock: returns the time in seconds, of a clock that goes on while the process is suspended.
            wall: returns the time of day in seconds.
            token: returns a new random text of small letters and digits.
        """
        self.fleet = Fleet(name, url, self, token)
        self._fleet_host, self._clock = host, clock
        self.seats.use(key)
        self.seats.wall = wall
        self._sent: dict[str, dict[str, float]] = {}

    # -- for the fleet -----------------------------------------------------------------------------------------

    def report(self) -> tuple[bool, int, Mapping[str, int], Mapping[str, Figures]]:
        """Returns what the fleet knows of this process (`Local.report`)."""
        room = {
            name: max(0, min(self.limits.worlds_max - len(self.worlds), kind.worlds_max - self._of_kind[name]))
            for name, kind in self.kinds.items()
        }
        figures = {}
        for name, world in self.worlds.items():
            self.fleet.update(name, world.properties)
            taken = self.seats.foreign(name)[-TAKEN_MAX:]
            age_s = round(max(0.0, self.now - world.made_at), 1)
            locked = world.locked or world.ending is not None
            figures[name] = Figures(world.players, world.free, locked, age_s, world.properties, taken)
        load = sum(1 + world.kind.players_max - world.free for world in self.worlds.values())
        return self.draining, load, room, figures

    def take(self, name: str, entry: WorldEntry, revision: int) -> None:
        """Makes the data of a world ready that was given to this process (`Local.take`)."""

        def done(folder: str | None) -> None:
            if folder is None:
                self.fleet.release(name, asleep=True)
            else:
                self.fleet.ready(name, folder, revision)

        if entry.folder and entry.clean:
            done(entry.folder)
        else:
            self._fleet_host.take(name, entry.folder, revision, done)

    def begin(self, name: str, entry: WorldEntry) -> bool:
        """Begins a world that this process has now (`Local.begin`)."""
        kind = self.kinds.get(entry.kind)
        if kind is None or name in self.worlds:
            return False
        try:
            self._fleet_host.locate(name, entry.folder)
            world = self.restore(name, kind, dict(entry.properties), entry.code)
        except WorldsError as error:
            logger.error("%s", error)
            return False
        world.stays = entry.stays
        return True

    def lose(self, name: str) -> None:
        """Leaves a world that another process has now (`Local.lose`). Its clients come back there."""
        world = self.worlds.pop(name, None)
        if world is None:
            return
        world.ending = "the world goes on at another server"
        self.rest(world)
        try:
            world.game.shut_down(world.ending, AWAY_S, messages.GOING_AWAY)
            self._fleet_host.left(world)
        except Exception:
            self.faults.report("leaving a world")
        self._of_kind[world.kind.name] -= 1
        self._codes.pop(world.code, None)
        self.seats.ended(name)

    def owns(self, name: str) -> bool:
        """Returns whether this process may change a world now. May be called from any thread."""
        return self.fleet.owns(name, self._clock())

    def release(self) -> None:
        """Gives all worlds up whose data are saved and closed, because the process ends."""
        for name in tuple(self.fleet.mine):
            self.fleet.release(name, asleep=False)

    # -- the directory -----------------------------------------------------------------------------------------

    def create(  # type: ignore[override]
        self,
        kind: str,
        properties: Mapping[str, object] | None = None,
        *,
        private: bool = False,
        name: str = "",
        stays: bool = False,
    ) -> HostedWorld | RemoteWorld:
        """Makes a world, here if it has a name, and otherwise at the process with the least load.

        Raises:
            WorldsError: the world cannot be made; the text says why.
        """
        found, checked = self.kind(kind), checked_properties(properties or {})
        if name and self.fleet.taken(checked_name(name, "name")):
            raise WorldsError(f"name = {name!r}: there is a world of that name")
        target = self.fleet.place(found.name)
        if not target:
            raise WorldsError(
                STOPPING if self.draining else f"there is no room for a world of the kind {found.name} now"
            )
        if name or target != self.fleet.me:  # another process may be making one of this name at this moment
            code = self._new_code() if private else ""
            return self._create_at(target, name or self._new_name(found), found, checked, code, stays)
        world = super().create(kind, checked, private=private, stays=stays)
        folder = self._fleet_host.folder(world.name)
        self.fleet.claim(world.name, WorldEntry("", found.name, checked, world.code, folder, stays=stays))
        return world

    def _create_at(
        self, process: str, name: str, kind: Kind, properties: dict[str, Property], code: str, stays: bool
    ) -> RemoteWorld:
        self.fleet.give(name, process, WorldEntry(process, kind.name, properties, code, stays=stays))
        self.counts["created_elsewhere"] += process != self.fleet.me
        return RemoteWorld(name, kind, properties, code, self.fleet.address(process), kind.players_max)

    def _new_name(self, kind: Kind) -> str:
        while True:  # the identifier of the process makes it the only one
            self._numbers[kind.name] += 1
            name = f"{kind.name}-{self.fleet.me}-{self._numbers[kind.name]}"
            if not self.fleet.taken(name):
                return name

    def get(self, name: str) -> HostedWorld:
        """Returns a world of this process. Raises `WorldsError`: it has none of that name."""
        other = None if name in self.worlds else self.elsewhere(name)
        if other is not None:
            raise WorldsError(f"the world {name!r} is at {other.url}; ask there")
        return super().get(name)

    def end(self, name: str, reason: str, *, keep: bool = False) -> None:
        """Ends a world of this process. Arguments and errors as for `Directory.end`."""
        world = self.get(name)
        if not self.owns(name):
            raise WorldsError(f"the world {name!r} cannot be ended now: the fleet cannot be reached")
        super().end(name, reason, keep=keep)
        self._codes.pop(world.code, None)
        after = self.fleet.release if keep else None
        self._fleet_host.closed(name, lambda: after(name, asleep=True) if after else self.fleet.end(name))

    def remember(self, name: str, kind: Kind, properties: dict[str, Property], code: str) -> None:
        """Does nothing: the fleet has the worlds that come back."""

    def _look_after(self, world: HostedWorld, now: float) -> None:
        if self.owns(world.name):
            super()._look_after(world, now)

    def elsewhere(self, name: str) -> RemoteWorld | None:
        """Returns a world of another process; None: there is none of that name, or its process is gone."""
        owner, entry = self.fleet.owner(name), self.fleet.entry(name)
        kind = None if entry is None else self.kinds.get(entry.kind)
        if not owner or owner == self.fleet.me or entry is None or kind is None:
            return None
        figures = self.fleet.figures(owner, name)
        free = kind.players_max if figures is None else figures.free
        sent = self._sent.get(name, {})
        for number in [number for number, until in sent.items() if until < self.now]:
            del sent[number]
        free -= sum(number not in (figures.taken if figures else ()) for number in sent)
        properties = dict(entry.properties if figures is None else figures.properties)
        locked = figures is not None and figures.locked
        return RemoteWorld(name, kind, properties, entry.code, self.fleet.address(owner), free, locked)

    def rooms(self, kind: Kind) -> list[HostedWorld | RemoteWorld]:
        """Returns all worlds of a kind that have begun, of all processes."""
        found: list[HostedWorld | RemoteWorld] = [world for world in self.worlds.values() if world.kind is kind]
        for name in self.fleet.of_kind(kind.name):
            world = None if name in self.worlds else self.elsewhere(name)
            if world is not None:
                found.append(world)
        return found

    def coded(self, code: str) -> HostedWorld | RemoteWorld:  # type: ignore[override]
        """Returns the private world of a code, of any process. Raises `WorldsError`: there is none."""
        if code in self._codes:
            return super().coded(code)
        found = self.elsewhere(self.fleet.coded(code))
        if found is None:
            raise WorldsError(f"there is no world with the code {code[:40]!r}")
        return found

    def entries(self, *, named: bool = False) -> list[dict[str, Any]]:
        """Returns the entries of the worlds of all processes. Arguments as for `Directory.entries`."""
        others = []
        for name in self.fleet.worlds:
            world = None if name in self.worlds else self.elsewhere(name)
            if world is not None and (named or not world.code):
                figures = self.fleet.figures(self.fleet.owner(name), name)
                others.append(world.entry(figures, named))
        return super().entries(named=named) + others

    # -- seats -------------------------------------------------------------------------------------------------

    def seat(self, name: str, subject: str, data: Any, reason: str) -> Go:
        """Reserves a seat in a world of any process. Arguments and errors as for `Worlds.seat`."""
        world = None if name in self.worlds or not name else self.elsewhere(name)
        if world is None:
            return super().seat(name, subject, data, reason)
        if world.free < 1:
            raise WorldsError(f"the world {name!r} is full ({world.kind.players_max} players)")
        return Go(world.url + self.path(world, subject, data), world.code, [], reason)

    def path(self, world: HostedWorld | RemoteWorld, subject: str, data: Any) -> str:
        """Reserves a seat in a world of any process. Returns the path at which a client takes it."""
        if isinstance(world, HostedWorld):
            return super().path(world, subject, data)
        try:
            number, token = self.seats.reserve_elsewhere(world.name, subject, data)
        except (ValueError, TypeError, OverflowError) as error:
            raise WorldsError(f"data = {type(data).__name__}: cannot be sent to another server ({error})") from error
        path = f"/{world.name}?seat={token}"
        if len(path) > fields.PATH_MAX:
            raise WorldsError(
                f"data: too long for the way to another server ({len(path) - fields.PATH_MAX} characters)"
            )
        self._sent.setdefault(world.name, {})[number] = self.now + self.seats.seat_s
        return path

    # -- the way in --------------------------------------------------------------------------------------------

    def route(self, target: str) -> Way | str:
        """Returns what a target leads to: here, or to the lobby, which finds the world."""
        name, _, query = target[: fields.PATH_MAX].partition("?")
        name = name.strip("/")
        if not name or name in VERBS or name in self.worlds:
            return super().route(target)
        try:
            return self.lobby_way(Wanted(name, query))
        except WorldsError as error:
            return str(error)

    def may_ask(self, target: str, address: str) -> bool:
        """Returns whether an address may send a request now; those that the lobby answers have a limit."""
        if name_in(target) in self.worlds or not name_in(target) or self._limit(address).take(self.now):
            return True
        self.counts["refused_often"] += 1
        return False

    def tick(self, now: float) -> None:
        """Does what is due: call it about ten times per second."""
        self.fleet.tick(self._clock())
        super().tick(now)
        for name in [name for name in self._sent if not self.fleet.taken(name)]:
            del self._sent[name]

    def stats(self) -> dict[str, Any]:
        """Returns figures for `/stats`."""
        fleet = self.fleet
        return {
            **super().stats(),
            "fleet_processes": 1 + sum(1 for _ in fleet.others()),
            "fleet_worlds": len(fleet.worlds),
            "fleet_holds": fleet.holds(fleet.now),
            "fleet_counts": dict(fleet.counts),
        }
