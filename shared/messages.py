"""The wire: every message there is, drawn.

A message is one binary WebSocket message: a MessagePack array `[kind, field, ...]`. Whatever is numerous
travels as packed little-endian records in a MessagePack `bin`.

    client -> server                                     server -> client
      1 Hello    version scene name token resume           17 Welcome   version tick entity scene resume
      2 Inputs   first acked rows                          18 Snapshot  tick newest margins first fates verdicts
      3 Ping     sent corrections                                       drops segment*
      4 Bye      code reason wait                          19 Terrain   x y z offset total chunk
      5 Command  number tick seen name payload             20 Pong      sent tick
      6 Resync                                             21 Happened  tick name payload
      7 Restart  tick                                      22 Shared    values
                                                           23 NextHappened  number
                                                            4 Bye       code reason wait

    Inputs.rows    n * [i8 move_x, i8 move_y, u8 buttons], for the ticks first, first + 1, ...
    Snapshot       the state at the end of `tick`; how early the client's inputs came (margins, n * i16 in 1/8192
                   s, for the ticks up to `newest`); what became of those from `first` on (fates, n * u8); and of
                   its commands (verdicts, n * [u32 number, u8 verdict]); which segments it no longer sees (drops,
                   n * [i32 x, y, z]); then each segment in which anything changed (`shared.snapshot`).
    Terrain        a part of a packed segment (`shared.blocks.pack`), which is complete with byte `total`.
    Command        something to do at the start of `tick`; `seen` is the tick at which the client drew the others.
    Resync         the client has lost track: everything it sees, anew.
    Restart        the client's time has been set: the inputs sent for `tick` and later are withdrawn, and come anew.
    Hello.token    proves who the client is, where the server asks for it. Hello.resume is the one of the latest
                   `Welcome`, to go on as the player that one was about.
    Happened       something that the game's rules tell, once. Its payload is MessagePack, as a command's.
    NextHappened   the number of the `Happened` that comes next, where the client may expect another one: some were
                   dropped, or lost with a connection. The first one that a player is told has the number 0.
    Shared         values of the game that all clients know, by name: a score, the time left. All of them, each time.
    Ping           `corrections`: how often the client has corrected its prediction so far, for the operator.
    Pong.tick      the server's time in ticks when it answered: 17.25 is a quarter of a tick after tick 17.

`decode(any bytes)` gives a message whose every field has been checked, or raises `ProtocolError`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import msgpack

from shared import checks
from shared.blocks import PACKED_MAX
from shared.bounds import FATES_S, TICK_RATE_MAX, in_ticks

VERSION = 3

MESSAGE_MAX = 256 * 1024
"""No message of the server is longer, in bytes."""
CLIENT_MESSAGE_MAX = 8 * 1024
"""No message of a client is longer, in bytes."""
INPUT_ROWS_MAX = 64
INPUT_ROW_BYTES = 3
NAME_MAX = 32
SCENE_FIELDS_MAX = 32
REASON_MAX = 500
FATES_MAX = in_ticks(FATES_S, TICK_RATE_MAX, 1)
"""Most margins, and most input statuses, in one snapshot."""
DROPS_MAX = 4096
VERDICTS_MAX = 128
COMMAND_MAX = (1 << 32) - 1
PAYLOAD_MAX = 1024
SEGMENTS_MAX = 1024
TOKEN_MAX = 2048
RESUME_BYTES = 16
LIST_MAX = 8 * 1024
CLIENT_LIST_MAX = 8
TABLE_MAX = 64
"""No list and no table has more items, however long the message: what a head claims is set aside in memory."""
TICK_MAX = (1 << 53) - 1
FIRST_MAX = TICK_MAX - INPUT_ROWS_MAX
ENTITY_MAX = (1 << 31) - 1

# The fate of an input, as the server tells it for each tick.
USED, REPEATED, NEUTRALISED, IDLE = range(4)
"""USED: the client's own input of that tick. REPEATED: it was missing, the latest to arrive was used again.
NEUTRALISED: missing for so long that the entity stood still. IDLE: the client had not begun."""
MARGIN_REFUSED = -(1 << 15)
"""Stands for the margin of an input that was refused."""

DONE, OVERLAPS, OUT_OF_REACH, TOO_MANY, INVALID, FORBIDDEN, FAILED, UNSAVED = range(8)
"""The verdict on a command."""
VERDICT_TEXTS = (
    "done",
    "an entity is in the way",
    "out of reach",
    "too many",
    "not possible there",
    "not allowed",
    "the server failed",
    "the server cannot save just now",
)

# Close codes.
GOING_AWAY, PROTOCOL, TEXT, TOO_BIG, INTERNAL = 1001, 1002, 1003, 1009, 1011
WRONG_VERSION, WRONG_SCENE, MALFORMED, FULL, TOO_SLOW, NO_HELLO, TAKEN_OVER, UNAUTHORISED = range(4001, 4009)


class ProtocolError(ValueError):
    """The peer sent something that is not a message; the text says what."""


class Hello(NamedTuple):
    """A client introduces itself. `scene`: digests of the scene it was built for; empty: it takes the server's."""

    version: int
    scene: dict[str, bytes]
    name: str
    token: str = ""
    resume: bytes = b""


class Inputs(NamedTuple):
    """Inputs for consecutive ticks, and the newest snapshot the client has applied."""

    first: int
    acked: int
    rows: bytes


class Ping(NamedTuple):
    """Asks for the server's time; `sent` is any number of the client's and comes back."""

    sent: float
    corrections: int = 0


class Command(NamedTuple):
    """Something to do once, at the start of `tick` or as soon as possible after it. Numbers ascend."""

    number: int
    tick: int
    seen: float
    name: str
    payload: bytes


class Resync(NamedTuple):
    """The client's copy is damaged: it needs everything anew."""


class Restart(NamedTuple):
    """Withdraws the inputs for `tick` and later ticks that the server has not used yet; the client sends them anew."""

    tick: int


class Bye(NamedTuple):
    """Goes before the connection closes. `wait`: come back in so many seconds; negative: do not."""

    code: int
    reason: str
    wait: float


class Welcome(NamedTuple):
    """The client is in: its entity and the rules."""

    version: int
    tick: int
    entity: int
    scene: dict[str, Any]
    resume: bytes = b""


class Snapshot(NamedTuple):
    """The world at the end of `tick`, as far as it changed for this client since the one before.

    `newest` is the highest tick that an input has come for, -1 before the first.
    """

    tick: int
    newest: int
    margins: bytes
    first: int
    fates: bytes
    verdicts: bytes
    drops: bytes
    segments: tuple[list[Any], ...]


class Terrain(NamedTuple):
    """Bytes `offset` and following of a packed segment of `total` bytes, in order."""

    x: int
    y: int
    z: int
    offset: int
    total: int
    chunk: bytes


class Pong(NamedTuple):
    """The server's time in ticks."""

    sent: float
    tick: float


class Happened(NamedTuple):
    """The game's rules tell something, at the end of `tick`."""

    tick: int
    name: str
    payload: bytes


class Shared(NamedTuple):
    """The values that the game shares with all clients, by name."""

    values: dict[str, Any]


class NextHappened(NamedTuple):
    """The number of the next `Happened`, counted from the player's first: what was not received before it is lost."""

    number: int


Message = (
    Hello
    | Inputs
    | Ping
    | Bye
    | Command
    | Resync
    | Restart
    | Welcome
    | Snapshot
    | Terrain
    | Pong
    | Happened
    | Shared
    | NextHappened
)
Check = Callable[[Any], bool]


def _whole(low: int, high: int) -> Check:
    return lambda value: type(value) is int and low <= value <= high


def _bytes(longest: int, of: int = 1) -> Check:
    return lambda value: type(value) is bytes and len(value) <= longest and len(value) % of == 0


def _text(longest: int) -> Check:
    return lambda value: type(value) is str and len(value) <= longest


def _finite(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _named(value: Any) -> bool:
    return type(value) is dict and all(type(name) is str for name in value)


def _resume(value: Any) -> bool:
    return type(value) is bytes and len(value) in (0, RESUME_BYTES)


def _digests(value: Any) -> bool:
    return (
        type(value) is dict
        and len(value) <= SCENE_FIELDS_MAX
        and all(type(name) is str and type(digest) is bytes and len(digest) <= 8 for name, digest in value.items())
    )


_tick = _whole(-1, TICK_MAX)
_first = _whole(0, FIRST_MAX)
_rows = _bytes(INPUT_ROWS_MAX * INPUT_ROW_BYTES, INPUT_ROW_BYTES)
_segment = _whole(-(1 << 23), (1 << 23) - 1)

KINDS: dict[int, tuple[type[Any], tuple[Check, ...]]] = {
    1: (Hello, (_whole(0, 1 << 31), _digests, _text(NAME_MAX), _text(TOKEN_MAX), _resume)),
    2: (
        Inputs,
        (_first, _tick, _rows),
    ),
    3: (Ping, (_finite, _whole(0, COMMAND_MAX))),
    4: (Bye, (_whole(0, 4999), _text(REASON_MAX), _finite)),
    5: (Command, (_whole(0, COMMAND_MAX), _tick, _finite, _text(NAME_MAX), _bytes(PAYLOAD_MAX))),
    6: (Resync, ()),
    7: (Restart, (_first,)),
    17: (
        Welcome,
        (_whole(0, 1 << 31), _tick, _whole(1, ENTITY_MAX), lambda value: type(value) is dict, _resume),
    ),
    18: (
        Snapshot,
        (
            _tick,
            _tick,
            _bytes(FATES_MAX * 2, 2),
            _tick,
            _bytes(FATES_MAX),
            _bytes(VERDICTS_MAX * 5, 5),
            _bytes(DROPS_MAX * 12, 12),
        ),
    ),
    19: (Terrain, (_segment, _segment, _segment, _whole(0, PACKED_MAX), _whole(1, PACKED_MAX), _bytes(PACKED_MAX))),
    20: (Pong, (_finite, _finite)),
    21: (Happened, (_tick, _text(NAME_MAX), _bytes(PAYLOAD_MAX))),
    22: (Shared, (_named,)),
    23: (NextHappened, (_whole(0, TICK_MAX),)),
}
CLIENT_KINDS = frozenset({1, 2, 3, 4, 5, 6, 7})
SERVER_KINDS = frozenset({4, 17, 18, 19, 20, 21, 22, 23})
_KIND_OF = {kind: number for number, (kind, _) in KINDS.items()}
_INPUTS_HEAD = bytes((0x94, _KIND_OF[Inputs]))
_SNAPSHOT_HEAD, _SNAPSHOT_KIND = b"\xdc", bytes((_KIND_OF[Snapshot],))
pack: Callable[[Any], bytes] = msgpack.Packer().pack
"""Half the time of `msgpack.packb`, which makes a packer and its buffer anew for each message."""


def encode(message: Message) -> bytes:
    """One message as bytes."""
    kind = _KIND_OF[type(message)]
    fields = (*message[:-1], *message.segments) if isinstance(message, Snapshot) else message
    return pack((kind, *fields))


def join_snapshot(header: tuple[int, int, bytes, int, bytes, bytes, bytes], segments: int, parts: bytes) -> bytes:
    """A snapshot from its first seven fields and so many segments' parts, encoded already (shared by many clients)."""
    n = 1 + len(header) + segments
    fields = pack(header)[1:]  # without their own head, which is one byte
    return b"".join((_SNAPSHOT_HEAD, n.to_bytes(2, "big"), _SNAPSHOT_KIND, fields, parts))


def shown(value: Any) -> str:
    """A peer's value in the text of an error: short, and not opened if it is nested (it may be so a thousand deep)."""
    return type(value).__name__ if isinstance(value, list | dict) else str(value)[:40]


def pack_value(value: Any) -> bytes:
    """A small MessagePack value, as the payload of a command or of `Happened`.

    Raises:
        ValueError: it is none, or longer than `PAYLOAD_MAX` bytes.
    """
    try:
        payload: bytes = msgpack.packb(value)
        unpack_value(payload)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{checks.shown(value)}: {_unpackable(error)}") from error
    if len(payload) > PAYLOAD_MAX:
        raise ValueError(f"a value of {len(payload)} bytes: longer than {PAYLOAD_MAX}")
    return payload


def _unpackable(error: Exception) -> str:
    """Why a value cannot be packed."""
    if isinstance(error, UnicodeEncodeError):
        return f"a text in it, {checks.shown(error.object)}, is none that UTF-8 can hold"
    return f"not a MessagePack value ({' '.join(str(error).split())[:80]})"


def unpack_value(payload: bytes) -> Any:
    """The reverse of `pack_value`.

    Raises:
        ProtocolError: the bytes are not MessagePack.
    """
    try:
        return msgpack.unpackb(payload, max_array_len=PAYLOAD_MAX, max_map_len=TABLE_MAX)
    except Exception as error:  # msgpack raises some ten kinds for bytes that are not MessagePack
        raise ProtocolError(f"payload: not MessagePack ({type(error).__name__})") from error


def decode(data: bytes, kinds: frozenset[int], longest: int, lists: int = LIST_MAX) -> Message:
    """The message in `data`, one of `kinds`, at most `longest` bytes, no list of more than `lists` items.

    Raises:
        ProtocolError: for anything else, whatever the bytes are.
    """
    if len(data) > longest:
        raise ProtocolError(f"message of {len(data)} bytes: longer than {longest}")
    try:
        parts = msgpack.unpackb(data, strict_map_key=True, max_array_len=lists, max_map_len=TABLE_MAX)
    except Exception as error:  # msgpack raises some ten kinds for bytes that are not MessagePack
        raise ProtocolError(f"not MessagePack ({type(error).__name__})") from error
    if type(parts) is not list or not parts or type(parts[0]) is not int or parts[0] not in kinds:
        raise ProtocolError("not a message of this side")
    kind, checks = KINDS[parts[0]]
    values = parts[1:]
    if kind is Snapshot and len(checks) <= len(values) <= len(checks) + SEGMENTS_MAX:
        values[len(checks) :] = [tuple(values[len(checks) :])]
    elif len(values) != len(checks):
        raise ProtocolError(f"{kind.__name__}: {len(values)} fields instead of {len(checks)}")
    for name, value, check in zip(kind._fields, values, checks, strict=False):
        if not check(value):
            raise ProtocolError(f"{kind.__name__}.{name} = {shown(value)}: not allowed")
    return kind(*values)  # type: ignore[no-any-return]


def decode_from_client(data: bytes) -> Message:
    """What a server may receive. Raises `ProtocolError`.

    Nearly all of it is `Inputs`: those in order take 0.66 us here and not 1.36, for the rest `decode` is the judge.
    """
    if data[:2] == _INPUTS_HEAD and len(data) < 2 * INPUT_ROWS_MAX * INPUT_ROW_BYTES:
        try:
            _, first, acked, rows = msgpack.unpackb(data)
        except Exception:
            return decode(data, CLIENT_KINDS, CLIENT_MESSAGE_MAX, CLIENT_LIST_MAX)
        if type(first) is type(acked) is int and 0 <= first <= FIRST_MAX and -1 <= acked <= TICK_MAX and _rows(rows):
            return Inputs(first, acked, rows)
    return decode(data, CLIENT_KINDS, CLIENT_MESSAGE_MAX, CLIENT_LIST_MAX)


def decode_from_server(data: bytes) -> Message:
    """What a client may receive. Raises `ProtocolError`.

    Nearly all of it is what `join_snapshot` makes: one in order, with few margins, that answers no command and drops
    nothing takes 1.1 us here and not 2.1; for the rest `decode` is the judge.
    """
    if data[:1] == _SNAPSHOT_HEAD and data[3:4] == _SNAPSHOT_KIND and len(data) <= MESSAGE_MAX:
        try:
            _, tick, newest, margins, first, fates, verdicts, drops, *segments = msgpack.unpackb(
                data, strict_map_key=True, max_array_len=LIST_MAX, max_map_len=TABLE_MAX
            )
        except Exception:
            return decode(data, SERVER_KINDS, MESSAGE_MAX)
        if (
            type(tick) is type(newest) is type(first) is int
            and type(margins) is type(fates) is bytes
            and verdicts == drops == b""
            and -1 <= tick <= TICK_MAX
            and -1 <= newest <= TICK_MAX
            and -1 <= first <= TICK_MAX
            and len(margins) in (0, 2, 4)
            and len(fates) <= FATES_MAX
            and len(segments) <= SEGMENTS_MAX
        ):
            return Snapshot(tick, newest, margins, first, fates, verdicts, drops, tuple(segments))
    return decode(data, SERVER_KINDS, MESSAGE_MAX)
