"""Matchmaking: gives a world to each client in the lobby, the fullest one that fits, or a new one."""

from collections.abc import Mapping

from server.bucket import Bucket
from server.players.ticket import Property
from server.worlds.directory import Directory
from server.worlds.hosted import HostedWorld
from server.worlds.kinds import Kind, WorldsError, matches
from server.worlds.lobby import Lobby, LobbySession, Request
from server.worlds.queue import Queue
from server.worlds.remote import RemoteWorld
from shared import messages
from shared.messages import Go


class Matchmaking:
    """The matchmaking of one server.

    Args:
        directory: the worlds.
    """

    lobby: Lobby
    """The clients that ask for worlds."""

    def __init__(self, directory: Directory) -> None:
        self._directory = directory
        rate = directory.limits.creations_per_s
        self._creations = Bucket(rate, max(1.0, 2 * rate))
        self._queues = {name: Queue(kind, directory.faults) for name, kind in directory.kinds.items()}

    @property
    def waiting(self) -> int:
        """Number of clients that wait for a match."""
        return sum(map(len, self._queues.values()))

    def kind(self, name: str) -> Kind:
        """Returns a kind by its name. Raises `WorldsError`: there is none of that name."""
        return self._directory.kind(name)

    def tick(self, now: float) -> None:
        """Gives worlds to those who wait, as far as there are any, and tells the others how it goes."""
        for name, queue in self._queues.items():
            if queue:
                self._serve(self._directory.kinds[name], now)
                queue.tell(self.lobby, now)
        self.lobby.tick(now)

    def ask(self, session: LobbySession, now: float) -> None:
        """Answers a client that asks for a world, or lets it wait."""
        request = session.request
        assert session.ticket is not None
        try:
            if request.verb == "match":
                kind = self._fitting(request)
                self._queues[kind.name].add(session)
                self._serve(kind, now)
            elif request.verb == "join":
                world = self._directory.coded(request.code)
                if world.free < request.seats:
                    raise WorldsError(f"the world has no {request.seats} free seats")
                self._send_on(session, world, "joined by code")
            else:
                kind = self._creatable(self._fitting(request))
                if not self._creations.take(now):
                    raise WorldsError("too many worlds are being made; try again in a second")
                world = self._directory.create(kind.name, request.properties, private=request.private)
                self._send_on(session, world, "created")
        except WorldsError as error:
            self._directory.counts["refused"] += 1
            self.lobby.refuse(session, messages.NOT_ADMITTED, str(error))
        except Exception:
            self._directory.faults.report("a request for a world")
            self.lobby.refuse(session, messages.INTERNAL, "internal error")

    def gone(self, session: LobbySession) -> None:
        """Takes a client that waits no longer out of its queue."""
        for queue in self._queues.values():
            queue.drop(session)

    def _serve(self, kind: Kind, now: float) -> None:
        """Gives worlds to those who wait for one of a kind, as far as there are any."""
        queue = self._queues[kind.name]
        for group in queue.groups(now):
            seats = sum(session.request.seats for session in group)
            try:
                found = self._room(kind, group[0].request.properties, seats) if kind.pair is None else None
                world = found or self._new_room(kind, group, now)
            except WorldsError as error:
                for session in group:
                    queue.drop(session)
                    self.lobby.refuse(session, messages.NOT_ADMITTED, str(error))
                continue
            if world is None:
                queue.wait(group)
                continue
            for session in group:
                queue.drop(session)
                self._send_on(session, world, "matched")

    def _rooms(self, kind: Kind) -> list[HostedWorld | RemoteWorld]:
        """Returns all worlds of a kind."""
        return [world for world in self._directory.worlds.values() if world.kind is kind]

    def _room_for(self, kind: Kind) -> bool:
        """Returns whether a world of a kind can be made now."""
        return not self._directory.draining and self._directory.room_for(kind)

    def _room(self, kind: Kind, wanted: Mapping[str, Property], seats: int) -> HostedWorld | RemoteWorld | None:
        """Returns the public world with the most players that has room and the properties; None: there is none."""
        found = [
            world
            for world in self._rooms(kind)
            if not (world.code or world.locked)
            and world.ending is None
            and matches(world.properties, wanted)
            and world.free >= seats
        ]
        return min(found, key=lambda world: world.free, default=None)

    def _new_room(self, kind: Kind, group: list[LobbySession], now: float) -> HostedWorld | RemoteWorld | None:
        """Makes a world for a group; None: not now.

        Raises:
            WorldsError: it can never be made.
        """
        self._creatable(kind)
        if not self._room_for(kind) or not self._creations.take(now):
            return None
        first, *others = (session.request.properties for session in group)
        common = {name: value for name, value in first.items() if all(each.get(name) == value for each in others)}
        return self._directory.create(kind.name, common)

    def _fitting(self, request: Request) -> Kind:
        """Returns the kind that a client asks for. Raises `WorldsError`: there is none, or it has too few seats."""
        kind = self._directory.kind(request.kind)
        if request.seats > kind.players_max:
            raise WorldsError(f"seats = {request.seats}: the worlds of the kind {kind.name} have {kind.players_max}")
        return kind

    def _creatable(self, kind: Kind) -> Kind:
        """Returns a kind. Raises `WorldsError`: clients may not make worlds of it."""
        if not kind.create:
            raise WorldsError(f"clients may not make worlds of the kind {kind.name}")
        return kind

    def _send_on(self, session: LobbySession, world: HostedWorld | RemoteWorld, reason: str) -> None:
        """Reserves the seats of a client and its friends, and sends the client there."""
        assert session.ticket is not None
        own = self._directory.path(world, session.ticket.subject, None)
        friends = [self._directory.path(world, "", None) for _ in range(session.request.seats - 1)]
        self._directory.counts[session.request.verb] += 1
        self._go(session, Go(world.url + own, world.code, friends, reason))

    def _go(self, session: LobbySession, go: Go) -> None:
        """Sends a client on."""
        self.lobby.send_on(session, go)
