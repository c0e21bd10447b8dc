"""The directory of the worlds of one server: makes, finds and ends them."""

import secrets
from collections import Counter
from collections.abc import Mapping
from typing import Any

from server.config.limits import Limits
from server.observability.errors import FaultReporter
from server.players.ticket import Property
from server.worlds.api import RulesWorlds
from server.worlds.host import Host
from server.worlds.hosted import HostedWorld
from server.worlds.kinds import Kind, WorldsError, checked_name, checked_properties
from server.worlds.remote import RemoteWorld
from server.worlds.seats import Seats
from shared import messages
from shared.messages import Go

STOPPING = "the server is about to stop"
"""Reason for clients that ask for a world while the server drains."""
CODE_SIGNS = "ABCDEFGHJKMNPQRSTUVWXYZ23456789"
"""Characters of codes: none that looks like another."""
CODE_LENGTH = 6
"""Length of a code; 887 million codes exist."""


class Directory:
    """The worlds of one server.

    Args:
        kinds: the kinds of worlds.
        limits: the limits.
        host: makes the games and runs the ticks.
        key: key of the seats, at least 32 bytes; None: a new one.
        faults: where exceptions in our own code are reported.
    """

    def __init__(
        self,
        kinds: Mapping[str, Kind],
        limits: Limits,
        host: Host,
        *,
        key: bytes | None = None,
        faults: FaultReporter | None = None,
    ) -> None:
        self.kinds, self.limits = dict(kinds), limits
        self.worlds: dict[str, HostedWorld] = {}
        self.asleep: dict[str, tuple[Kind, dict[str, Property], str]] = {}
        """Worlds that have ended and come back when a player joins: kind, properties and code, by name."""
        self.draining = False
        """Whether no new worlds begin, because the server is about to stop."""
        self.counts = Counter[str]()
        """Numbers of worlds and clients by what became of them."""
        self.seats = Seats(key or secrets.token_bytes(32), limits.seat_s)
        self.faults = faults or FaultReporter()
        self._host = host
        self.now = 0.0
        """Time in seconds at which `look_after` was called last."""
        self._numbers, self._of_kind = Counter[str](), Counter[str]()
        self._codes: dict[str, str] = {}

    def kind(self, name: str) -> Kind:
        """Returns the kind of a name. An empty name stands for the only kind there is.

        Raises:
            WorldsError: there is no such kind.
        """
        if not name and len(self.kinds) == 1:
            return next(iter(self.kinds.values()))
        if name not in self.kinds:
            raise WorldsError(f"kind = {name[:40]!r}: there is no such kind; there are {', '.join(self.kinds)}")
        return self.kinds[name]

    def create(
        self,
        kind: str,
        properties: Mapping[str, object] | None = None,
        *,
        private: bool = False,
        name: str = "",
        stays: bool = False,
    ) -> HostedWorld:
        """Makes a world.

        Args:
            kind: name of its kind.
            properties: its properties.
            private: whether only those with its code or a seat may join.
            name: its name; empty: the next one of the kind.
            stays: whether it never ends because it is empty.

        Raises:
            WorldsError: the world cannot be made; the text says why.
        """
        found, checked = self.kind(kind), checked_properties(properties or {})
        if self.draining:
            raise WorldsError(STOPPING)
        if not self.room_for(found):
            most = min(self.limits.worlds_max, found.worlds_max)
            raise WorldsError(f"there are too many worlds now (limits: {most} of the kind {found.name})")
        if name and (checked_name(name, "name") in self.worlds or name in self.asleep):
            raise WorldsError(f"name = {name!r}: there is a world of that name")
        world = self.restore(name or self._new_name(found), found, checked, self._new_code() if private else "")
        world.stays = stays
        self.counts["created"] += 1
        return world

    def room_for(self, kind: Kind) -> bool:
        """Returns whether the limits allow one more world of a kind."""
        return len(self.worlds) < self.limits.worlds_max and self._of_kind[kind.name] < kind.worlds_max

    def restore(self, name: str, kind: Kind, properties: dict[str, Property], code: str) -> HostedWorld:
        """Begins a world that has a name already: a saved one, or one that comes back.

        Raises:
            WorldsError: the host cannot make its game.
        """
        world = HostedWorld(name, kind, properties, code, self.seats, self.now)
        try:
            world.begin(self._host.begin(world))
        except WorldsError:
            raise
        except Exception as error:
            self.faults.report(f"beginning the world {name}")
            raise WorldsError(f"the world {name!r} could not be made") from error
        world.game.api.hosting = RulesWorlds(self, world)
        self.worlds[name] = world
        self._of_kind[kind.name] += 1
        if code:
            self._codes[code] = name
        if kind.runs_empty or world.game.players:
            self.wake(world)
        return world

    def remember(self, name: str, kind: Kind, properties: dict[str, Property], code: str) -> None:
        """Takes note of a world that has ended and comes back when a player joins it."""
        self.asleep[name] = (kind, properties, code)
        if code:
            self._codes[code] = name

    def end(self, name: str, reason: str, *, keep: bool = False) -> None:
        """Ends a world: its players get the reason, and its place is free.

        Args:
            name: name of the world.
            reason: the reason.
            keep: whether the world may come back with its data.

        Raises:
            WorldsError: there is no such world.
        """
        world = self.get(name)
        world.ending = reason
        self.rest(world)
        try:
            world.game.shut_down(reason, -1.0, messages.ENDED)
        except Exception:
            self.faults.report("ending a world")
        del self.worlds[name]
        self._of_kind[world.kind.name] -= 1
        self.seats.ended(name)
        if keep:
            self.remember(name, world.kind, world.properties, world.code)
        else:
            self._codes.pop(world.code, None)
        self.counts["ended"] += 1
        try:
            self._host.ended(world, keep=keep)
        except Exception:
            self.faults.report("ending a world")

    def get(self, name: str) -> HostedWorld:
        """Returns the world of a name; one that has ended and may come back does so.

        Raises:
            WorldsError: there is no such world.
        """
        if name in self.worlds:
            return self.worlds[name]
        if name in self.asleep:
            if not self.room_for(self.asleep[name][0]):
                raise WorldsError(f"the world {name!r} cannot come back now: there are too many worlds")
            world = self.restore(name, *self.asleep[name])
            del self.asleep[name]
            return world
        raise WorldsError(f"there is no world {name[:40]!r}")

    def coded(self, code: str) -> HostedWorld:
        """Returns the private world of a code.

        Raises:
            WorldsError: there is no such world.
        """
        name = self._codes.get(code)
        if name is None:
            raise WorldsError(f"there is no world with the code {code[:40]!r}")
        return self.get(name)

    def entries(self, *, named: bool = False) -> list[dict[str, Any]]:
        """Returns the entries of the public worlds, in the order in which they were made.

        Args:
            named: all worlds, with codes and players' names, for operators and rules.
        """
        return [world.entry(self.now, named) for world in self.worlds.values() if named or not world.code]

    def seat(self, name: str, subject: str, data: Any, reason: str) -> Go:
        """Reserves a seat in a world. Returns the message that sends a client there.

        Raises:
            WorldsError: there is no such world, or it has no free seat.
        """
        world = self.get(name)
        if world.ending is not None:
            raise WorldsError(f"the world {name!r} has ended")
        if world.free < 1:
            raise WorldsError(f"the world {name!r} is full ({world.kind.players_max} players)")
        return Go(self.path(world, subject, data), world.code, [], reason)

    def look_after(self, now: float) -> None:
        """Lets worlds rest, and ends them, if it is time.

        Args:
            now: the current time in seconds.
        """
        self.now = now
        self.seats.expire(now)
        for world in tuple(
            self.worlds.values()
        ):  # nothing can become of a world that rests before it is empty for long
            if world.ticking or world.ending is not None or now - world.used_at >= world.kind.empty_s:
                self._look_after(world, now)

    def path(self, world: HostedWorld | RemoteWorld, subject: str, data: Any) -> str:
        """Reserves a seat in a world. Returns the path at which a client takes it."""
        assert isinstance(world, HostedWorld)
        world.used_at = self.now
        return f"/{world.name}?seat={self.seats.reserve(world.name, subject, data, self.now)}"

    def wake(self, world: HostedWorld) -> None:
        """Starts the ticks of a world."""
        if not world.ticking and world.ending is None:
            world.ticking = True
            self._host.wake(world)

    def rest(self, world: HostedWorld) -> None:
        """Stops the ticks of a world."""
        if world.ticking:
            world.ticking = False
            self._host.rest(world)

    # -- inside --------------------------------------------------------------------------------------------

    def _look_after(self, world: HostedWorld, now: float) -> None:
        if world.ending is not None:
            self.end(world.name, world.ending)
            return
        if not world.empty:
            world.used_at = now
            return
        if world.ticking and not world.kind.runs_empty:
            self.rest(world)
        if now - world.used_at >= world.kind.empty_s and not world.stays:
            self.end(world.name, "the world was empty", keep=world.kind.keep)

    def _new_name(self, kind: Kind) -> str:
        """Returns the next name of a kind."""
        while True:
            self._numbers[kind.name] += 1
            name = f"{kind.name}-{self._numbers[kind.name]}"
            if name not in self.worlds and name not in self.asleep:
                return name

    def _new_code(self) -> str:
        while True:
            code = "".join(secrets.choice(CODE_SIGNS) for _ in range(CODE_LENGTH))
            if code not in self._codes:
                return code
