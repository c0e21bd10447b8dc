"""A host of worlds in simulated time, and clients made of bytes."""

from collections.abc import Callable
from typing import Any

from server.config.limits import Limits
from server.game import Game
from server.rules import Rules
from server.worlds.hosted import HostedWorld
from server.worlds.kinds import Kind, kind_of
from server.worlds.worlds import Worlds
from shared import messages
from shared.messages import Go, Hello, Message, decode_from_server, encode
from shared.scene import load_scene

FLAT = load_scene("flat")


class SimpleHost:
    """A host whose worlds tick when `run` says so, and which remembers what it was asked to do."""

    def __init__(self) -> None:
        self.done: list[tuple[str, str]] = []
        self.ticking: dict[str, HostedWorld] = {}
        self.authenticate: Callable[[str], str] | None = None

    def begin(self, world: HostedWorld) -> Game:
        self.done.append(("begin", world.name))
        limits = Limits(clients_max=world.kind.players_max)
        return Game(world.kind.scene, rules=world.kind.rules(), limits=limits, authenticate=self.authenticate)

    def wake(self, world: HostedWorld) -> None:
        self.done.append(("wake", world.name))
        self.ticking[world.name] = world

    def rest(self, world: HostedWorld) -> None:
        self.done.append(("rest", world.name))
        del self.ticking[world.name]

    def ended(self, world: HostedWorld, *, keep: bool) -> None:
        self.done.append(("kept" if keep else "ended", world.name))


class Peer:
    """One client, as bytes: it connects to a path, says hello, and keeps what it gets."""

    def __init__(self, server: "Server", path: str, *, name: str = "Ann", token: str = "", resume: bytes = b"") -> None:
        self.server, self.path, self.name, self.token = server, path, name, token
        self.got: list[Message] = []
        self.over: tuple[int, str] | None = None
        self.unread = 0
        """Bytes that have not reached the client, as the server sees it."""
        self.refused = ""
        way = server.worlds.route(path)
        self.way: Any = None
        self.session: Any = None
        if isinstance(way, str):
            self.refused = way
            return
        self.way, self.session = way, way.open(self, server.now)
        self.send(Hello(messages.VERSION, {}, name, token, resume))

    def send(self, message: Message | bytes) -> None:
        """Sends a message to the server; with bytes, takes one of the server (the side of `Transport`)."""
        if isinstance(message, bytes):
            self.got.append(decode_from_server(message))
        else:
            self.way.receive(self.session, encode(message), self.server.now)

    def outstanding(self) -> int:
        return self.unread

    def close(self, code: int, reason: str) -> None:
        self.over = code, reason
        self.way.lost(self.session, self.server.now)

    def lose(self) -> None:
        """Breaks the connection."""
        self.way.lost(self.session, self.server.now)

    @property
    def go(self) -> Go:
        """The `Go` that the client has got."""
        (found,) = (message for message in self.got if isinstance(message, Go))
        return found

    @property
    def welcome(self) -> messages.Welcome | None:
        """The welcome that the client has got, if any."""
        return next((message for message in self.got if isinstance(message, messages.Welcome)), None)


class Server:
    """Worlds of some kinds in simulated time."""

    def __init__(self, *kinds: Kind, limits: Limits | None = None, **more: Any) -> None:
        self.host = SimpleHost()
        self.host.authenticate = more.get("authenticate")
        self.now = 100.0
        self.worlds = Worlds({kind.name: kind for kind in kinds}, limits or Limits(), self.host, **more)
        self.worlds.tick(self.now)

    def run(self, seconds: float) -> None:
        """Runs ticks of 1/32 s; every third one the worlds do what is due."""
        for k in range(round(seconds * 32)):
            self.now += 1 / 32
            for world in tuple(self.host.ticking.values()):
                world.game.tick(self.now, self.now)
            if k % 3 == 0:
                self.worlds.tick(self.now)

    def peer(self, path: str, **more: Any) -> Peer:
        """Connects a client."""
        return Peer(self, path, **more)

    def play(self, path: str, **more: Any) -> Peer:
        """Connects a client that follows `Go`."""
        peer = Peer(self, path, **more)
        return self.peer(peer.go.path, **more)


def kind(name: str = "arena", rules: type[Rules] = Rules, **limits: Any) -> Kind:
    """Returns a kind on the flat scene."""
    return kind_of(name, rules, FLAT, **limits)
