"""The events of a client. `poll()` returns them in order; a `match` statement tells them apart."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from shared.checks import Cell

if TYPE_CHECKING:
    from shared.scene import Scene


@dataclass(frozen=True)
class Joined:
    """The player has joined: inputs count from `tick` on.

    Only `Waiting`, `Matched`, `Moved`, `SegmentLoaded` and `Left` may come before it.

    `entity` is the number of the own entity, and `scene` the one that the server plays.
    """

    entity: int
    scene: "Scene"
    tick: int


@dataclass(frozen=True)
class Waiting:
    """The client waits for a world: at place `position` of `waiting` who wait, for `waited_s` seconds so far.

    0 stands for what the server does not report. `data` is what the queue of the kind of world adds.
    """

    position: int
    waiting: int
    waited_s: float
    data: dict[str, Any]


@dataclass(frozen=True)
class Matched:
    """The server has found or made the world `world`, and the client goes there; `Joined` follows.

    `code` is the code of a private world, for friends to join (`Client.join(url, code=...)`); empty: it has none.
    `seats` has the seats that were reserved for others, each of them for one player and for some seconds only
    (`Client.join(url, seat=...)`). If the world does not take the client after all, the client asks the server again:
    then a second `Matched` follows, or `Left`.
    """

    world: str
    code: str
    seats: tuple[str, ...]


@dataclass(frozen=True)
class Moved:
    """The rules have sent the player to the world `world`, and the client goes there; `Joined` follows, or `Left`.

    `world` is empty for the default world. `reason` is the text of the rules.
    """

    world: str
    reason: str


@dataclass(frozen=True)
class HandedOver:
    """The client goes on at another server of the same world, `server`, because the server before asked for it.

    Nothing else changes: entity, prediction and view go on without a pause. `reason` is the text of the server.
    """

    server: str
    reason: str


@dataclass(frozen=True)
class Disconnected:
    """The connection is lost; the client tries to reconnect in `wait_s` seconds. One event per attempt.

    The view shows the own entity moving for about 3 s more; then it stands still.
    """

    reason: str
    wait_s: float


@dataclass(frozen=True)
class Resumed:
    """The client has reconnected after `away_s` seconds and goes on with the same entity at `tick`.

    Commands and edits that were requested meanwhile are sent now. If the server did not keep the entity for that long,
    the event is a new `Joined` instead.
    """

    tick: int
    away_s: float


@dataclass(frozen=True)
class Left:
    """The connection is over for good; `code` is the close code, and `reason` says why.

    `wait_s` is the time after which the server asks to connect again, in seconds; negative if it does not ask.
    """

    code: int
    reason: str
    wait_s: float = -1.0


@dataclass(frozen=True)
class Corrected:
    """The server's state of the own entity differed from the predicted one.

    `fields` names the parts of the state that differed at `tick`. `blocks` is the distance between both positions at
    that tick, in blocks. `ticks` is the number of ticks that were replayed. `cause` is the most likely reason.
    """

    tick: int
    fields: tuple[str, ...]
    blocks: float
    ticks: int
    cause: str


@dataclass(frozen=True)
class Answered:
    """The result of an edit or a command, named by the `number` that `edit` or `command` returned.

    `verdict` is "done", or says why it was refused: the reason that the rules gave, or a text of the SDK. The client
    then takes back a predicted edit.
    """

    number: int
    done: bool
    verdict: str


@dataclass(frozen=True)
class Happened:
    """A message that the rules of the game sent at `tick`; the rules define what `name` and `data` mean.

    It comes after the snapshot of the end of `tick`, so an entity that it names is known to the client.
    """

    tick: int
    name: str
    data: Any


@dataclass(frozen=True)
class Announced:
    """An event that the behaviour of an entity has announced at `tick` (`Body.announce`).

    For the own entity, and for what it has spawned, it comes with the prediction, in the frame of the own input, and
    `number` is positive: a later `Withdrawn` of that number takes it back. Without one, it is true. An event that was
    not predicted, and one of another entity, comes from the server, and `number` is 0.
    """

    tick: int
    entity: int
    name: str
    data: Any
    number: int = 0


@dataclass(frozen=True)
class Withdrawn:
    """The announcement of that `number` did not take place on the server."""

    number: int
    name: str


@dataclass(frozen=True)
class BehaviourFailed:
    """The predicted turn of a behaviour has raised an exception; nothing of that turn was done.

    `error` is its text, with the line of the code. The server's turn, which decides, has probably failed, too.
    """

    tick: int
    entity: int
    behaviour: str
    error: str


@dataclass(frozen=True)
class EventsDropped:
    """At this place, `count` events are missing, because too many waited.

    The server drops game events (`Happened`) if more than 1,024 wait for a slow or lost connection. The client drops
    events if the program leaves more than 10,000 of them; then other events may be among them. `Joined`, `Matched`,
    `Moved`, `HandedOver`, `Disconnected`, `Resumed` and `Left` are never dropped.

    `count` is 0 if the client cannot know the number: announcements may be missing after a lost connection to a world
    that several servers share.
    """

    count: int


@dataclass(frozen=True)
class Diverged:
    """An alarm: client and server computed different results from the same inputs, or a copy is damaged.

    This must never happen. `what` names the difference. The client has asked the server for the whole world again.
    """

    tick: int
    what: str


@dataclass(frozen=True)
class Resynchronised:
    """Prediction has started again at `tick`, `ticks_skipped` ticks after the tick where it was.

    No input was sent for the skipped ticks. If `ticks_skipped` is negative, the client has withdrawn inputs for later
    ticks and sends these again. `cause` is one of:

    - "program paused": the program did not call `update` for too long;
    - "server silent": no snapshot came for more than 4 s, so prediction had stopped;
    - "server behind": the server's time went back, because the server stood still (or this computer's clock jumped);
    - "server ahead": the server's time went forward, because this program's clock stood still;
    - "path changed": inputs take much more or less time to the server than before;
    - "reconnected": the connection was lost, and play goes on.
    """

    tick: int
    ticks_skipped: int
    cause: str = ""


@dataclass(frozen=True)
class SegmentLoaded:
    """The blocks of a segment have arrived."""

    segment: Cell


Event = (
    Joined
    | Waiting
    | Matched
    | Moved
    | HandedOver
    | Disconnected
    | Resumed
    | Left
    | Corrected
    | Answered
    | Happened
    | Announced
    | Withdrawn
    | BehaviourFailed
    | EventsDropped
    | Diverged
    | Resynchronised
    | SegmentLoaded
)
