"""A game with fake links, which keep the messages sent to them, and with a simulated time."""

from dataclasses import replace
from typing import Any

from server.config.limits import Limits
from server.game import Game
from server.game.session import Session
from server.journal.recorded_world import Saves
from server.rules import Rules
from shared import edits, fields, messages
from shared.edits import Edit
from shared.messages import Bye, Command, Hello, Message, Snapshot, decode_from_server, encode
from shared.snapshot import NO_FIELDS, ROW
from tests.packed_turns import unpack_turns
from tests.worlds import scene

HELLO = Hello(messages.VERSION, {}, "")
FLOOR = [[0, 0, 0, 32, 32, 1, 1]]


class FakeLink:
    """A transport that keeps the messages sent to it. It may call the game back while it is being closed."""

    def __init__(self, table: "Table", *, calls_back: bool = False) -> None:
        self.table = table
        self.calls_back = calls_back
        self.sent: list[Message] = []
        self.closings: list[tuple[int, str]] = []
        self._waiting = 0
        self.session: Session

    def send(self, message: bytes) -> None:
        assert len(message) <= fields.MESSAGE_MAX
        self.sent.append(decode_from_server(message))

    @property
    def waiting(self) -> int:
        """Bytes on the way. Setting it makes the game ask for it again, which otherwise happens only after a send."""
        return self._waiting

    @waiting.setter
    def waiting(self, n: int) -> None:
        self._waiting = n
        self.session.stream.flow.look()

    def outstanding(self) -> int | None:
        return self._waiting

    def close(self, code: int, reason: str) -> None:
        self.closings.append((code, reason))
        if self.calls_back:
            self.table.game.lost(self.session, self.table.now)

    def say(self, *said: Message | bytes) -> None:
        for message in said:
            data = message if isinstance(message, bytes) else encode(message)
            self.table.game.receive(self.session, data, self.table.now)

    def got(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.sent if isinstance(message, kind)]

    def refusal(self) -> tuple[int, str]:
        """Returns the code and the reason of the close, which the client has received in a `Bye`, too."""
        ((code, reason),) = self.closings
        assert self.sent[-1] == Bye(code, reason, -1.0)
        return code, reason


class Table:
    """A game and its time. By default, a player whose connection is lost leaves at once."""

    def __init__(
        self,
        limits: Limits | None = None,
        fill: list[list[int]] = FLOOR,
        rules: Rules | None = None,
        resume_s: float = 0.0,
        saves: Saves | None = None,
        **changes: Any,
    ) -> None:
        values: dict[str, Any] = {"origin": (0, 0, 0), "size": (1, 1, 1), "spawns": ((16.0, 16.0, 1.0),)}
        limits = replace(limits or Limits(), resume_s=resume_s)
        made = scene(fill, **(values | changes))
        self.game = Game(made, limits=limits, compiled=False, rules=rules, saves=saves)
        self.now = 0.0
        self.tick_s = 1 / self.game.scene.tick_rate

    def connect(self, *said: Message | bytes, calls_back: bool = False) -> FakeLink:
        link = FakeLink(self, calls_back=calls_back)
        link.session = self.game.open(link, self.now)
        link.say(*said)
        return link

    def join(self) -> FakeLink:
        link = self.connect(HELLO)
        self.tick()
        assert link.session.entity
        return link

    def tick(self, n: int = 1) -> None:
        for _ in range(n):
            self.now += self.tick_s
            self.game.tick(self.now, self.now)

    def lose(self, link: FakeLink) -> None:
        self.game.lost(link.session, self.now)

    @property
    def tick_number(self) -> int:
        return self.game.world.tick


def whole(part: list[Any]) -> list[Any]:
    """Returns a segment's part with its left-out fields."""
    return part + NO_FIELDS[len(part) - 4 :]


def ids(snapshot: Snapshot) -> list[int]:
    """Returns the numbers of all entities in a snapshot."""
    found: list[int] = []
    for part in map(whole, snapshot.segments):
        found += [turn[0] for turn in unpack_turns(part[4])] + [row[0] for row in ROW.iter_unpack(part[5])]
    return found


def gone(snapshot: Snapshot) -> list[int]:
    packed = b"".join(whole(part)[6] for part in snapshot.segments)
    return [int.from_bytes(packed[at : at + 4], "little") for at in range(0, len(packed), 4)]


def order(number: int, tick: int, *block: int) -> Command:
    """Returns the command to edit a block: x, y, z, kind."""
    return Command(number, tick, 0.0, edits.NAME, edits.pack(Edit(*block)))
