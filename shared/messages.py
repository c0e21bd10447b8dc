"""The messages between client and server: their fields, their encoding and their checks.

A message is one binary WebSocket message: a MessagePack array `[kind, field, ...]`. Lists of many small things are
packed little-endian records in a MessagePack `bin`. docs/protocol.md explains each message with examples.

    client -> server                                     server -> client
      1 Hello    version scene name token resume           17 Welcome   version tick entity scene resume
      2 Inputs   first acked rows                          18 Snapshot  tick newest margins first statuses verdicts
      3 Ping     sent corrections                                       drops segment*
      4 Bye      code reason wait                          19 Terrain   x y z offset total chunk
      5 Command  number tick seen name payload             20 Pong      sent tick
      6 Resync                                             21 Happened  tick name payload
      7 Restart  tick                                      22 Shared    values
      8 Beside   version token resume                      23 NextHappened  number
      9 Held     after behind                              24 Announce  tick entity name payload
                                                           25 Refusal   number reason
                                                           26 Private   values
                                                           27 Go        path code seats reason
                                                           28 Waiting   payload
                                                           29 Edges     addresses
                                                           30 HandOver  address reason
                                                            4 Bye       code reason wait

    Inputs.rows    n * [i8 move_x, i8 move_y, u8 buttons], for the ticks first, first + 1, ...; in a scene with aim
                   n * [i8 move_x, i8 move_y, u8 buttons, i16 aim_x, i16 aim_y, i16 aim_z]
    Held           the latest input holds for `shared.bounds.REPEATS_S` seconds, until a row replaces it. Its tick comes
                   `after` ticks after the newest one that was sent; `behind` ticks before it is `acked`.
    Snapshot       the state at the end of `tick`. margins (n * i16, in 1/8192 s): arrival margins of the client's
                   inputs for the ticks up to `newest`. statuses (n * u8): input statuses of the ticks from `first` on.
                   verdicts (n * [u32 number, u8 verdict]): results of commands. drops (n * [i32 x, y, z]): segments
                   that the client no longer sees. Then one field per segment in which anything changed
                   (`shared.snapshot`).
    Terrain        a part of a packed segment (`shared.blocks.pack`), which has `total` bytes.
    Command        a request to carry out at the start of `tick`; `seen` is the view tick, at which the client drew the
                   other entities.
    Resync         asks the server to send everything that the client sees again, because the client's copy is wrong.
    Restart        withdraws the inputs sent for `tick` and later; the client sends them again.
    Hello.token    proves the client's identity, if the server asks for it.
    Hello.resume   the `resume` of the latest `Welcome`, to reconnect as the same player.
    Happened       a game event, sent once. The payload is MessagePack, as in a command.
    NextHappened   the number of the next `Happened`, sent if the client may expect another number, because events were
                   dropped or lost with a connection. The first event that a player gets has the number 0.
    Announce       an event of an entity's behaviour. It counts as a `Happened` for `NextHappened`.
    Shared         all shared values of the game by name, each time: a score, for example.
    Private        all values of the game that only this player gets, each time.
    Refusal        a reason for the verdict FORBIDDEN; it comes ahead of the snapshot with that verdict.
    Go             asks the client to join another world: a match that was found, or where the rules send the player.
    Waiting        progress while a client waits for a world.
    Edges          the addresses of other servers of the same world.
    HandOver       asks the client to go on at another server of the same world, without a pause.
    Beside         the first message of a second connection: the player goes on over it as soon as its inputs arrive
                   there in time. `resume` is the one of the first connection.
    Ping           `corrections`: number of corrections of the client's prediction so far, for the operator.
    Pong.tick      the server time in ticks when it answered: 17.25 is a quarter of a tick after tick 17.

`decode(any bytes)` returns a message whose fields have all been checked (`shared.fields`), or raises `ProtocolError`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import msgpack

from shared import fields
from shared.connection_messages import Beside as Beside
from shared.connection_messages import Bye as Bye
from shared.connection_messages import Hello as Hello
from shared.connection_messages import Welcome as Welcome
from shared.fields import (
    CLIENT_MESSAGE_MAX,
    INPUT_ROW_BYTES,
    INPUT_ROWS_MAX,
    LIST_MAX,
    MESSAGE_MAX,
    SEGMENTS_MAX,
    TABLE_MAX,
    TICK_MAX,
    shown,
    whole_rows,
)
from shared.game_messages import Announce as Announce
from shared.game_messages import Edges as Edges
from shared.game_messages import Go as Go
from shared.game_messages import HandOver as HandOver
from shared.game_messages import Happened as Happened
from shared.game_messages import NextHappened as NextHappened
from shared.game_messages import Private as Private
from shared.game_messages import Refusal as Refusal
from shared.game_messages import Shared as Shared
from shared.game_messages import Waiting as Waiting

VERSION = 4
"""Version of the protocol; both sides must have the same one."""

# Input statuses: the server reports one for each tick.
USED, REPEATED, NEUTRALISED, IDLE = range(4)
"""Input statuses. USED: the client's own input of that tick. REPEATED: it was missing, and the latest that arrived was
used again. NEUTRALISED: inputs were missing for too long, and the entity stood still. IDLE: the client had not sent any
input yet."""
MARGIN_REFUSED = -(1 << 15)
"""Value that stands for the margin of an input that was refused, or not sent."""

DONE, OVERLAPS, OUT_OF_REACH, TOO_MANY, INVALID, FORBIDDEN, FAILED, UNSAVED = range(8)
"""Verdicts on a command; `VERDICT_TEXTS` explains them."""
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
"""Texts of the verdicts, by number."""

GOING_AWAY, PROTOCOL, TEXT, TOO_BIG, INTERNAL = 1001, 1002, 1003, 1009, 1011
"""Close codes of WebSocket (RFC 6455) that the server and the client use."""
WRONG_VERSION, WRONG_SCENE, MALFORMED, FULL, TOO_SLOW, NO_HELLO, TAKEN_OVER, UNAUTHORISED = range(4001, 4009)
KICKED, NOT_ADMITTED, ENDED = range(4009, 4012)
"""Close codes of this protocol. FULL: the server has no room for another player. TOO_SLOW: the connection cannot keep
up, or nothing was received for too long. NO_HELLO: no `Hello` came in time. TAKEN_OVER: another one goes on.
KICKED: the rules removed the player. NOT_ADMITTED: the rules do not let the client join. ENDED: the world has ended."""


class ProtocolError(ValueError):
    """The peer sent something that is not a valid message; the text says what is wrong."""


class Inputs(NamedTuple):
    """Inputs for the consecutive ticks from `first` on. `acked` is the newest snapshot that the client has applied."""

    first: int
    acked: int
    rows: bytes


class Held(NamedTuple):
    """Says that the latest input holds for some ticks (`Bounds.repeats`), until a row replaces it.

    Its tick is `after` ticks after the newest one that was sent: that of the latest row or `Held`. `behind` is the
    number of ticks from the newest snapshot that the client has applied to this tick.
    """

    after: int
    behind: int


class Ping(NamedTuple):
    """A request for the server's time. `sent` is any number that the client chooses; the answer repeats it."""

    sent: float
    corrections: int = 0


class Command(NamedTuple):
    """A command, carried out once, at the start of `tick` or as soon as possible after it. Numbers ascend."""

    number: int
    tick: int
    seen: float
    name: str
    payload: bytes


class Resync(NamedTuple):
    """A request to send everything again, because the client's copy of the world is wrong."""


class Restart(NamedTuple):
    """Withdraws the inputs for `tick` and later that the server has not used yet; the client sends them again."""

    tick: int


class Snapshot(NamedTuple):
    """The changes of the world up to the end of `tick` that concern one client, since the snapshot before.

    `newest` is the highest tick of which an input has arrived; -1 before the first input.
    """

    tick: int
    newest: int
    margins: bytes
    first: int
    statuses: bytes
    verdicts: bytes
    drops: bytes
    segments: tuple[list[Any], ...]


class Terrain(NamedTuple):
    """A piece of a segment's terrain: the bytes from `offset` on of a packed segment of `total` bytes."""

    x: int
    y: int
    z: int
    offset: int
    total: int
    chunk: bytes


class Pong(NamedTuple):
    """The answer to a `Ping`: its `sent`, and the server time in ticks."""

    sent: float
    tick: float


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
    | Announce
    | Refusal
    | Private
    | Go
    | Waiting
    | Edges
    | HandOver
    | Beside
    | Held
)
KINDS: dict[int, tuple[type[Any], tuple[fields.Check, ...]]] = {
    1: (Hello, (fields.version, fields.digests, fields.name, fields.token, fields.resume)),
    2: (Inputs, (fields.first, fields.tick, fields.rows)),
    3: (Ping, (fields.number, fields.count)),
    4: (Bye, (fields.code, fields.reason, fields.number)),
    5: (Command, (fields.count, fields.tick, fields.number, fields.name, fields.payload)),
    6: (Resync, ()),
    7: (Restart, (fields.first,)),
    8: (Beside, (fields.version, fields.token, fields.resume)),
    9: (Held, (fields.after, fields.index)),
    17: (Welcome, (fields.version, fields.tick, fields.entity, fields.table, fields.resume)),
    18: (
        Snapshot,
        (fields.tick, fields.tick, fields.margins, fields.tick, fields.statuses, fields.verdicts, fields.drops),
    ),
    19: (Terrain, (fields.segment, fields.segment, fields.segment, fields.offset, fields.total, fields.chunk)),
    20: (Pong, (fields.number, fields.number)),
    21: (Happened, (fields.tick, fields.name, fields.payload)),
    22: (Shared, (fields.names,)),
    23: (NextHappened, (fields.index,)),
    24: (Announce, (fields.tick, fields.entity, fields.name, fields.payload)),
    25: (Refusal, (fields.count, fields.reason)),
    26: (Private, (fields.names,)),
    27: (Go, (fields.place, fields.world_code, fields.paths, fields.reason)),
    28: (Waiting, (fields.payload,)),
    29: (Edges, (fields.addresses,)),
    30: (HandOver, (fields.address, fields.reason)),
}
"""Message class and checks of the fields, by the number of the kind. A snapshot's last field has no check here:
`shared.snapshot` checks the segments."""
CLIENT_KINDS = frozenset({1, 2, 3, 4, 5, 6, 7, 8, 9})
"""Kinds of messages that a client may send."""
SERVER_KINDS = frozenset({4, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30})
"""Kinds of messages that a server may send."""
_KIND_OF = {kind: number for number, (kind, _) in KINDS.items()}


def head_of(kind: type[Message]) -> bytes:
    """Returns the first two bytes of each message of a kind with at most 14 fields."""
    return bytes((0x91 + len(kind._fields), _KIND_OF[kind]))


_INPUTS_HEAD = head_of(Inputs)
_SNAPSHOT_HEAD, _SNAPSHOT_KIND = b"\xdc", bytes((_KIND_OF[Snapshot],))
_PACKER = msgpack.Packer()
pack: Callable[[Any], bytes] = _PACKER.pack
"""Packer of MessagePack values. `msgpack.packb` takes twice the time, because it creates a packer for each message."""
array_head: Callable[[int], bytes] = _PACKER.pack_array_header
"""Returns the first bytes of a MessagePack array with a number of items."""


def encode(message: Message) -> bytes:
    """Returns a message as bytes."""
    kind = _KIND_OF[type(message)]
    values = (*message[:-1], *message.segments) if isinstance(message, Snapshot) else message
    return pack((kind, *values))


def join_snapshot(header: tuple[int, int, bytes, int, bytes, bytes, bytes], segments: int, parts: bytes) -> bytes:
    """Returns an encoded snapshot, joined from parts that many clients share.

    Args:
        header: the first seven fields of `Snapshot`.
        segments: number of segments in `parts`.
        parts: the segments' fields, encoded already.
    """
    count, head = 1 + len(header) + segments, pack(header)[1:]  # without the array's head, which is one byte
    return b"".join((_SNAPSHOT_HEAD, count.to_bytes(2, "big"), _SNAPSHOT_KIND, head, parts))


def decode(
    data: bytes, kinds: frozenset[int], longest: int, lists: int = LIST_MAX, row_bytes: int = INPUT_ROW_BYTES
) -> Message:
    """Returns the message in `data`.

    Args:
        data: any bytes.
        kinds: kinds of messages that are allowed.
        longest: longest message, in bytes.
        lists: limit of the items of a list.
        row_bytes: length of one input, `Scene.input_row_bytes`.

    Raises:
        ProtocolError: `data` is not such a message. No other exception is raised, for any bytes.
    """
    if len(data) > longest:
        raise ProtocolError(f"message of {len(data)} bytes: longer than {longest}")
    try:
        parts = msgpack.unpackb(data, strict_map_key=True, max_array_len=lists, max_map_len=TABLE_MAX)
    except Exception as error:  # msgpack raises about ten types of exceptions for such bytes
        raise ProtocolError(f"not MessagePack ({type(error).__name__})") from error
    if type(parts) is not list or not parts or type(parts[0]) is not int or parts[0] not in kinds:
        raise ProtocolError("not a list that begins with a kind of message which this side may send")
    kind, checks = KINDS[parts[0]]
    values = parts[1:]
    if kind is Snapshot and len(checks) <= len(values) <= len(checks) + SEGMENTS_MAX:
        values[len(checks) :] = [tuple(values[len(checks) :])]
    elif len(values) != len(checks):
        raise ProtocolError(f"{kind.__name__}: {len(values)} fields instead of {len(checks)}")
    for name, value, check in zip(kind._fields, values, checks, strict=False):
        if not check(value):
            raise ProtocolError(f"{kind.__name__}.{name} = {shown(value)}: not allowed")
    if kind is Inputs and not whole_rows(values[2], row_bytes):
        size = f"{len(values[2])} bytes"
        raise ProtocolError(f"Inputs.rows: {size}; must be at most {INPUT_ROWS_MAX} inputs of {row_bytes} bytes")
    return kind(*values)  # type: ignore[no-any-return]


def decode_from_client(data: bytes, row_bytes: int = INPUT_ROW_BYTES) -> Message:
    """Returns the message of a client in `data`.

    Nearly all messages of clients are `Inputs`. Valid ones take a short cut here, 0.66 us instead of 1.36; `decode`
    checks all others.

    Args:
        data: any bytes.
        row_bytes: length of one input, `Scene.input_row_bytes`.

    Raises:
        ProtocolError: `data` is not a message of a client.
    """
    if data[:2] == _INPUTS_HEAD and len(data) < 2 * INPUT_ROWS_MAX * row_bytes:
        try:
            _, first, acked, rows = msgpack.unpackb(data)
        except Exception:
            return decode(data, CLIENT_KINDS, CLIENT_MESSAGE_MAX, fields.CLIENT_LIST_MAX, row_bytes)
        if (
            type(first) is type(acked) is int
            and 0 <= first <= fields.FIRST_MAX
            and -1 <= acked <= TICK_MAX
            and type(rows) is bytes
            and whole_rows(rows, row_bytes)
        ):
            return Inputs(first, acked, rows)
    return decode(data, CLIENT_KINDS, CLIENT_MESSAGE_MAX, fields.CLIENT_LIST_MAX, row_bytes)


def decode_from_server(data: bytes) -> Message:
    """Returns the message of a server in `data`.

    Nearly all messages of a server are snapshots. Valid ones with at most two margins, no verdicts and no drops take a
    short cut here, 1.1 us instead of 2.1; `decode` checks all others.

    Raises:
        ProtocolError: `data` is not a message of a server.
    """
    if data[:1] == _SNAPSHOT_HEAD and data[3:4] == _SNAPSHOT_KIND and len(data) <= MESSAGE_MAX:
        try:
            _, tick, newest, margins, first, statuses, verdicts, drops, *segments = msgpack.unpackb(
                data, strict_map_key=True, max_array_len=LIST_MAX, max_map_len=TABLE_MAX
            )
        except Exception:
            return decode(data, SERVER_KINDS, MESSAGE_MAX)
        if (
            type(tick) is type(newest) is type(first) is int
            and type(margins) is type(statuses) is bytes
            and verdicts == drops == b""
            and -1 <= tick <= TICK_MAX
            and -1 <= newest <= TICK_MAX
            and -1 <= first <= TICK_MAX
            and len(margins) in (0, 2, 4)
            and len(statuses) <= fields.STATUSES_MAX
            and len(segments) <= SEGMENTS_MAX
        ):
            return Snapshot(tick, newest, margins, first, statuses, verdicts, drops, tuple(segments))
    return decode(data, SERVER_KINDS, MESSAGE_MAX)
