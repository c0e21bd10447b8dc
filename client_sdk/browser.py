"""The client for a page in a browser: the Python client in Pyodide, with numbers and texts towards JavaScript.

    client = BrowserClient.connect("ws://localhost:8765", name="Ann")
    client.set_input(1, 0)
    n = client.frame()          # once per picture; client.values[:n] is what to draw (`client_sdk.flat_view`)

Texts are JSON. Bytes within them are {"$bytes": base64}. Nothing blocks: the connection is opened meanwhile, and if it
fails, the event `Left` says why. In a hidden tab, `pump` takes the place of `frame`: it keeps the connection and the
prediction going without drawing.
"""

import base64
import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

from client_sdk import addresses
from client_sdk.base import BaseClient, set_link
from client_sdk.core import Core
from client_sdk.flat_view import COLUMNS, HEAD, STATES, FlatView, fields_of
from client_sdk.pending_events import PendingEvents
from client_sdk.transports.browser import BrowserTransport, OpenSocket, browser_socket
from shared.behaviours import Behaviour
from shared.checks import duration
from shared.inputs import make_input
from shared.scene import Scene

if TYPE_CHECKING:
    from client_sdk.events import Event

PATIENCE_S = 30.0
"""Time for which a client tries to reconnect, in seconds."""
SLEEP_S = 1.0
"""Longest wait that `due_s` names, in seconds: the connection has to be looked at about once per second."""


class BrowserClient(BaseClient):
    """A player on a server, for a page.

    `now` is a time in float seconds; left out, it is `time.monotonic()`. A page leaves it out.

    Args:
        core: the client's state machine.
        transport: moves the client's messages.
    """

    def __init__(self, core: Core, transport: BrowserTransport) -> None:
        super().__init__(core)
        self._transport = transport
        self._flat = FlatView()
        self._events = PendingEvents()
        self._blocks: set[tuple[int, int, int]] = set()

    @classmethod
    def connect(
        cls,
        url: str,
        *,
        name: str = "",
        token: str = "",
        link: str = "",
        behaviours: Iterable[type[Behaviour]] = (),
        patience_s: float = PATIENCE_S,
        timeout: float = 5.0,
        open_socket: OpenSocket = browser_socket,
    ) -> "BrowserClient":
        """Begins to connect to a server, and returns at once.

        Args:
            url: address of the server, like ws://localhost:8765; its path may be a world's.
            name: the player's name, shown to others, up to 32 characters.
            token: proves the client's identity, if the server asks for it.
            link: name of a simulated link; empty: none. `set_link` changes it later.
            behaviours: the classes of the game's behaviours.
            patience_s: the client tries to reconnect for this long after a lost connection, in seconds.
            timeout: the longest time of a handshake, in seconds.
            open_socket: opens a socket; the default is the browser's WebSocket.

        Raises:
            ValueError: an argument is not valid.
            ConnectError: `url` is not the address of a server.
        """
        core = Core(name, token=token, patience_s=patience_s, behaviours=behaviours)
        set_link(core, link or None)
        return cls(core, BrowserTransport(core, url, open_socket, duration(timeout, "timeout")))

    @classmethod
    def match(cls, url: str, kind: str, *, seats: int = 1, **options: Any) -> "BrowserClient":
        """Joins a world of a kind, one that has the given properties or a new one, as `Client.match` does."""
        own = addresses.options_of(cls.connect, options)
        return cls.connect(addresses.at(url, addresses.matching(kind, seats, options)), **own)

    @classmethod
    def create(cls, url: str, kind: str, *, private: bool = False, **options: Any) -> "BrowserClient":
        """Makes a world of a kind and joins it, as `Client.create` does."""
        own = addresses.options_of(cls.connect, options)
        return cls.connect(addresses.at(url, addresses.creating(kind, private, options)), **own)

    @classmethod
    def join(cls, url: str, *, code: str = "", seat: str = "", world: str = "", **options: Any) -> "BrowserClient":
        """Joins a world that exists already, as `Client.join` does. Pass one of `code`, `seat` and `world`."""
        return cls.connect(addresses.at(url, addresses.joining(code, seat, world)), **options)

    def pump(self, now: float | None = None) -> float:
        """Reads, predicts and sends what is due, without drawing. Returns the seconds until it is due again."""
        now = time.monotonic() if now is None else now
        self._transport.poll(now)
        self.core.controls.resolve(self.core.scene)
        self.core.port.update(now)
        self._transport.send(now)
        for event in self.core.events():
            self._events.append(event)
        return self._due(now)

    def frame(self, now: float | None = None) -> int:
        """Does what `pump` does, and writes what to draw to `values`. Returns the number of values (`flat_view`)."""
        now = time.monotonic() if now is None else now
        began = time.perf_counter()
        due_s = self.pump(now)
        core, flat = self.core, self._flat
        count = flat.write(core.view(now), core.scene)
        self._blocks |= self.blocks_changed()
        builder = core.prediction and core.timeline and core.clock
        delay_s = (core.clock.tick(now) - flat.values[HEAD.index("seen")]) / core.clock.rate if builder else 0.0
        flat.note(
            core.stats,
            state=STATES.index(core.state),
            events=len(self._events),
            blocks=len(self._blocks),
            delay_s=delay_s,
            due_s=due_s,
            frame_s=time.perf_counter() - began,
        )
        return count

    @property
    def values(self) -> "memoryview[float]":
        """The array of float64 that `frame` writes. Get it again if it has fewer values than `frame` has returned."""
        return self._flat.values

    def events(self) -> str:
        """Returns the events since the last call, oldest first: [{"type": "Joined", "entity": 7, ...}, ...].

        The types and their fields are those of `client_sdk.events`, without the scene of `Joined` (`scene`).
        """
        return _json([event_table(event) for event in self._events.take()] if self._events else [])

    def attributes(self) -> str:
        """Returns the attributes that have changed since the last call: {"7": {"name": "Ann"}, "9": null, ...}.

        null: the entity is not drawn any more.
        """
        return _json({str(entity): values for entity, values in self._flat.attributes().items()})

    def blocks(self) -> str:
        """Returns the segments whose blocks have changed, arrived or gone since the last call: [[x, y, z], ...]."""
        changed, self._blocks = self._blocks, set()
        return _json(sorted(changed))

    def kinds(self, x: int, y: int, z: int) -> bytes:
        """Returns the kinds of a segment's blocks: 32,768 bytes, by index z << 10 | y << 5 | x; air if not loaded."""
        return self.segment((x, y, z)).tobytes()

    def describe(self) -> str:
        """Returns the scene and how to read `values`; an empty table before the client knows the scene.

        {"scene": ..., "head": [names], "columns": [names], "fields": [names of each template], "states": [names]}
        """
        scene = self.core.scene
        if scene is None:
            return "{}"
        return _json(
            {
                "scene": scene.to_table(), "head": HEAD, "columns": COLUMNS, "fields": fields_of(scene),
                "states": STATES,
            }
        )  # fmt: skip

    def game(self) -> str:
        """Returns the values of the game, and where the client is: {"shared", "private", "world", "code", "seats"}."""
        own = {"world": self.world, "code": self.code, "seats": self.seats, "entity": self.entity}
        return _json({"shared": self.shared, "private": self.private, **own})

    def request(self, name: str, data: str = "null") -> int:
        """Sends a command with data as JSON. Returns its number, as `command` does."""
        return self.command(name, _from_json(json.loads(data)))

    def press(self, x: float, y: float, buttons: int = 0, aim: Sequence[float] | None = None) -> None:
        """Sets the player's input with buttons as bits, as `set_input` does; bit 0 is "jump" unless the scene differs.

        Args:
            x: east part of the direction, of length 0 to 1.
            y: north part of the direction.
            buttons: bits of the buttons that are held, in the order of the scene's `buttons`.
            aim: direction (x, y, z) in space; None: none.
        """
        self.core.set_input(make_input(x, y, buttons=buttons, aim=None if aim is None else tuple(aim)))

    def set_link(self, name: str) -> None:
        """Simulates a link on top of the real connection, by its name; empty: none."""
        self.link = name or None

    def verdict(self) -> str:
        """Returns the diagnosis for developers, as a table: {"verdict", "reason", "advice", "warnings"}."""
        return _json(self.diagnosis()._asdict())

    def close(self) -> None:
        """Leaves the game. A second call does nothing."""
        self.core.close()
        self._transport.close(0.0)
        for event in self.core.events():
            self._events.append(event)

    def _due(self, now: float) -> float:
        return min(max(self.core.port.next_update(now) - now, 0.0), SLEEP_S)

    def _filed(self) -> None:
        self._transport.send(time.monotonic())


def event_table(event: "Event") -> dict[str, Any]:
    """Returns an event as a table with its type and its fields."""
    assert is_dataclass(event)
    named = {field.name: getattr(event, field.name) for field in fields(event)}
    return {"type": type(event).__name__, **{name: value for name, value in named.items() if type(value) is not Scene}}


def _json(value: object) -> str:
    """Returns a value as JSON, which has no numbers that are not finite: null stands for them."""
    try:
        return json.dumps(value, default=_other, separators=(",", ":"), allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value), default=_other, separators=(",", ":"))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _other(value: object) -> object:
    """Returns a value that JSON does not know as one that it knows."""
    if isinstance(value, bytes):
        return {"$bytes": base64.b64encode(value).decode()}
    if isinstance(value, Mapping):
        return dict(value)
    return str(value)


def _from_json(value: Any) -> Any:
    """Returns a value from JSON, with its bytes."""
    if isinstance(value, dict):
        if value.keys() == {"$bytes"}:
            return base64.b64decode(value["$bytes"])
        return {name: _from_json(each) for name, each in value.items()}
    return [_from_json(each) for each in value] if isinstance(value, list) else value
