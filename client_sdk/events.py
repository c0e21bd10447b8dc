"""What happens to a client, as values: `poll()` gives them in order, a `match` statement tells them apart."""

from dataclasses import dataclass
from typing import Any

from shared.checks import Cell
from shared.scene import Scene


@dataclass(frozen=True)
class Joined:
    """The player is in: inputs count from here on. No event comes before it, but for `SegmentLoaded` and `Left`."""

    entity: int
    scene: Scene
    tick: int


@dataclass(frozen=True)
class Disconnected:
    """The connection is lost; the client tries to come back, the next time in `wait_s` seconds. Told once per attempt.

    Meanwhile the own entity goes on in the picture for some 3 s, then it stands.
    """

    reason: str
    wait_s: float


@dataclass(frozen=True)
class Resumed:
    """The client is back after `away_s` seconds, with the entity and everything that was ordered meanwhile.

    Where the server did not keep the entity for so long, there is a new `Joined` instead.
    """

    tick: int
    away_s: float


@dataclass(frozen=True)
class Left:
    """It is over. `wait_s`: come back in so many seconds; negative: do not."""

    code: int
    reason: str
    wait_s: float = -1.0


@dataclass(frozen=True)
class Corrected:
    """The server's world differed from the prediction of the own entity.

    `fields` names what differed at `tick`; `blocks` is how far the position was off then, `ticks` how many were
    replayed, and `cause` the best explanation.
    """

    tick: int
    fields: tuple[str, ...]
    blocks: float
    ticks: int
    cause: str


@dataclass(frozen=True)
class Answered:
    """The server's answer to a command: `verdict` is "done", or why not (and then what was predicted is undone)."""

    number: int
    done: bool
    verdict: str


@dataclass(frozen=True)
class Happened:
    """The game's rules tell something: what `name` and `data` mean is theirs.

    It comes once the world is known here as it was at the end of `tick`: an entity that it names is there.
    """

    tick: int
    name: str
    data: Any


@dataclass(frozen=True)
class EventsDropped:
    """Here `count` events are missing: more waited than are kept.

    They are the game's (`Happened`). They waited at the server for a slow or lost connection, or here because the
    program did not ask for 10,000 of them. Only then are other events among them, and `Joined`, `Disconnected`,
    `Resumed` and `Left` never.
    """

    count: int


@dataclass(frozen=True)
class Diverged:
    """The two sides computed different worlds from the same inputs, or a copy is damaged: an alarm.

    It must never happen; the client has asked for everything anew.
    """

    tick: int
    what: str


@dataclass(frozen=True)
class Resynchronised:
    """Prediction has begun anew at `tick`, `ticks_skipped` further than it was.

    For skipped ticks no input was sent; where the number is negative, inputs sent for ticks that have not come yet are
    withdrawn and sent anew. `cause` is one of:

    - "program paused": the program did not call `update` for too long;
    - "server behind": the server's time is behind what it was: the server stood still (or this computer's clock leapt);
    - "server ahead": the server's time is ahead of what it was: this program's clock stood still;
    - "path changed": inputs take much more or less time to the server than before;
    - "reconnected": the connection was lost, and play goes on.
    """

    tick: int
    ticks_skipped: int
    cause: str = ""


@dataclass(frozen=True)
class SegmentLoaded:
    """The blocks of a segment are there."""

    segment: Cell


Event = (
    Joined
    | Disconnected
    | Resumed
    | Left
    | Corrected
    | Answered
    | Happened
    | EventsDropped
    | Diverged
    | Resynchronised
    | SegmentLoaded
)
