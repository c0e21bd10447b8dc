"""The wire format: every message survives encoding and decoding, and any bytes are a message or a `ProtocolError`."""

import contextlib
import math
from collections.abc import Callable
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared import fields, messages
from shared.fields import CLIENT_LIST_MAX, CLIENT_MESSAGE_MAX, LIST_MAX, MESSAGE_MAX, STATUSES_MAX, TICK_MAX
from shared.inputs import Input, row
from shared.messages import (
    CLIENT_KINDS,
    KINDS,
    SERVER_KINDS,
    Announce,
    Beside,
    Bye,
    Command,
    Edges,
    Go,
    HandOver,
    Happened,
    Held,
    Hello,
    Inputs,
    Message,
    NextHappened,
    Ping,
    Pong,
    Private,
    ProtocolError,
    Refusal,
    Restart,
    Resync,
    Shared,
    Snapshot,
    Terrain,
    Waiting,
    Welcome,
    decode_from_client,
    decode_from_server,
    encode,
    join_snapshot,
)
from tests.lengths import examples

PART = [0, -1, 2, 7, bytes(33), bytes(4), bytes(3), 0, [1, {"name": "Ann"}]]
BLANK = Snapshot(0, 0, b"", 0, b"", b"", b"", ())
FROM_CLIENT: list[Message] = [
    Hello(1, {}, ""),
    Hello(1 << 31, {f"field {i}": bytes(8) for i in range(32)}, "n" * 32, "t" * 2048, bytes(16)),
    Inputs(0, -1, b""),
    Held(1, 0),
    Held(64, TICK_MAX),
    Inputs(TICK_MAX - 64, TICK_MAX, bytes(range(192))),
    Ping(-0.5),
    Ping(7, (1 << 32) - 1),
    Command(0, -1, -0.5, "", b""),
    Command((1 << 32) - 1, TICK_MAX, 1e300, "n" * 32, bytes(1024)),
    Resync(),
    Restart(0),
    Restart(TICK_MAX - 64),
    Bye(0, "", -1.0),
    Bye(4999, "é" * 500, 1e300),
    Beside(3, "", b""),
    Beside(1 << 31, "t" * 2048, bytes(16)),
]
FROM_SERVER: list[Message] = [
    Bye(1001, "going down", 2.0),
    Welcome(1, -1, 1, {"name": "flat", "spawns": [[0.5, 1, 2]]}, bytes(16)),
    Snapshot(0, -1, b"", -1, b"", b"", b"", ()),
    Snapshot(
        TICK_MAX,
        TICK_MAX,
        bytes(2 * STATUSES_MAX),
        TICK_MAX,
        bytes(STATUSES_MAX),
        bytes(640),
        bytes(12 * 4096),
        (PART, PART),
    ),
    Terrain(-(1 << 23), 0, (1 << 23) - 1, 0, 1, b""),
    Terrain(0, 0, 0, 48 * 1024, 48 * 1024, bytes(48 * 1024)),
    Pong(1.5, 17.25),
    Happened(TICK_MAX, "n" * 32, bytes(1024)),
    Announce(TICK_MAX, (1 << 31) - 1, "n" * 32, bytes(1024)),
    Shared({"score": [1, None, "two", {"three": 3.0}]}),
    NextHappened(TICK_MAX),
    Refusal((1 << 32) - 1, "é" * 500),
    Private({"role": "spy"}),
    Go("/arena-k7f3?seat=abc.def", "K7F3QD", ["/arena-k7f3?seat=ghi", "/" + "s" * 1023], "é" * 500),
    Go("/", "", [], ""),
    Go("wss://10.0.0.2:8766/arena-1?seat=abc", "", [], ""),
    Waiting(bytes(1024)),
    Edges([]),
    Edges(["ws://edge-1:8765", "wss://[::1]:1", "ws://play.example"]),
    HandOver("ws://127.0.0.1:65535", "é" * 500),
]


@pytest.mark.parametrize("message", FROM_CLIENT, ids=str)
def test_what_a_client_sends_arrives_as_it_was(message: Message) -> None:
    assert decode_from_client(encode(message)) == message


@pytest.mark.parametrize("message", FROM_SERVER, ids=lambda message: type(message).__name__)
def test_what_a_server_sends_arrives_as_it_was(message: Message) -> None:
    assert decode_from_server(encode(message)) == message


def test_every_kind_is_tried_and_has_a_check_for_each_field() -> None:
    assert {type(message) for message in FROM_CLIENT + FROM_SERVER} == {kind for kind, _ in KINDS.values()}
    assert set(KINDS) == CLIENT_KINDS | SERVER_KINDS
    for kind, checks in KINDS.values():
        assert len(checks) == len(kind._fields) - (kind is Snapshot)


@pytest.mark.parametrize("segments", [0, 1, 15, 16, 1024])
def test_a_snapshot_joined_from_encoded_segments_is_the_snapshot(segments: int) -> None:
    message = Snapshot(9, 12, b"\x01\x02", 8, b"\x00\x01", bytes(5), bytes(12), (PART,) * segments)
    assert decode_from_server(join_snapshot(message[:7], segments, msgpack.packb(PART) * segments)) == message


def test_each_side_refuses_messages_that_only_it_may_send() -> None:
    for message in FROM_CLIENT:
        if not isinstance(message, Bye):
            assert_refused(encode(message), server=True)
    for message in FROM_SERVER:
        if not isinstance(message, Bye):
            assert_refused(encode(message))


OUT_OF_BOUNDS: list[tuple[Message, str, list[Any]]] = [
    (Hello(1, {}, ""), "version", [-1, (1 << 31) + 1, True, 1.0, None]),
    (
        Hello(1, {}, ""),
        "scene",
        [{str(i): b"" for i in range(33)}, {"a": bytes(9)}, {"a": "text"}, {b"a": b""}, [], None],
    ),
    (Hello(1, {}, ""), "name", ["n" * 33, b"name", None, []]),
    (Hello(1, {}, ""), "token", ["t" * 2049, b"token", None]),
    (Hello(1, {}, ""), "resume", [bytes(15), bytes(17), "resume", None]),
    (Held(1, 0), "after", [0, -1, 65, True, 1.0]),
    (Held(1, 0), "behind", [-1, TICK_MAX + 1, None]),
    (Inputs(0, 0, b""), "first", [-1, TICK_MAX - 63, False, 0.0]),
    (Inputs(0, 0, b""), "acked", [-2, TICK_MAX + 1, None]),
    (Inputs(0, 0, b""), "rows", [bytes(195), bytes(579), bytes(4), bytes(1), "abc", None, [0, 0, 0]]),
    (Ping(0.0), "sent", [math.nan, math.inf, -math.inf, "1", True, None, [1.0]]),
    (Ping(0.0), "corrections", [-1, 1 << 32, 1.0, None]),
    (Command(0, 0, 0.0, "", b""), "number", [-1, 1 << 32, 0.0]),
    (Command(0, 0, 0.0, "", b""), "tick", [-2, TICK_MAX + 1]),
    (Command(0, 0, 0.0, "", b""), "seen", [math.nan, math.inf, None]),
    (Command(0, 0, 0.0, "", b""), "name", ["n" * 33, b"edit"]),
    (Command(0, 0, 0.0, "", b""), "payload", [bytes(1025), "text", [0, 0, 0, 1]]),
    (Bye(0, "", 0.0), "code", [-1, 5000, None]),
    (Bye(0, "", 0.0), "reason", ["r" * 501, b"r"]),
    (Bye(0, "", 0.0), "wait", [math.nan, math.inf, None]),
    (Restart(0), "tick", [-1, TICK_MAX - 63, 0.0, None]),
    (Welcome(1, 0, 1, {}), "version", [-1, (1 << 31) + 1]),
    (Welcome(1, 0, 1, {}), "tick", [-2, TICK_MAX + 1]),
    (Welcome(1, 0, 1, {}), "entity", [0, -1, 1 << 31]),
    (Welcome(1, 0, 1, {}), "scene", [[], None, {str(i): 0 for i in range(65)}]),
    (Welcome(1, 0, 1, {}), "resume", [bytes(1), None]),
    (Happened(0, "", b""), "tick", [-2, TICK_MAX + 1]),
    (Happened(0, "", b""), "name", ["n" * 33, None]),
    (Happened(0, "", b""), "payload", [bytes(1025), "text"]),
    (Announce(0, 1, "", b""), "tick", [-2, TICK_MAX + 1]),
    (Announce(0, 1, "", b""), "entity", [0, 1 << 31, None]),
    (Announce(0, 1, "", b""), "name", ["n" * 33, None]),
    (Announce(0, 1, "", b""), "payload", [bytes(1025), "text"]),
    (Refusal(0, ""), "number", [-1, 1 << 32, 1.0, None]),
    (Refusal(0, ""), "reason", ["r" * 501, None, b""]),
    (Private({}), "values", [[], {1: 2}, None]),
    (
        Go("/", "", [], ""),
        "path",
        [
            "",
            "arena",
            "ws://else",
            "ws:///a",
            "http://a/b",
            "ws://a:x/b",
            "/a b",
            "/a\n",
            "/ä",
            "/" + "s" * 1024,
            b"/",
            None,
        ],
    ),
    (Go("/", "", [], ""), "code", ["c" * 17, None, b""]),
    (Go("/", "", [], ""), "seats", [["/"] * 65, ["else"], [None], "/", None]),
    (Go("/", "", [], ""), "reason", ["r" * 501, None]),
    (Waiting(b""), "payload", [bytes(1025), "text", None]),
    (Beside(1, "", b""), "version", [-1, (1 << 31) + 1, True]),
    (Beside(1, "", b""), "token", ["t" * 2049, b"token", None]),
    (Beside(1, "", b""), "resume", [bytes(15), bytes(17), "resume", None]),
    (Edges([]), "addresses", [["ws://a"] * 65, ["/a"], ["ws://a/b"], ["ws://a:65536"], [None], "", None]),
    (HandOver("ws://a", ""), "address", ["", "a:1", "//a:1", "ws://", "ws://@a", "ws://[:::]:1", "ws://a:0", None]),
    (HandOver("ws://a", ""), "address", ["ws://" + "a" * 252]),
    (HandOver("ws://a", ""), "reason", ["r" * 501, None]),
    (NextHappened(0), "number", [-1, TICK_MAX + 1, 1.0, None]),
    (Shared({}), "values", [[], None, {b"name": 1}, {str(i): 0 for i in range(65)}]),
    (BLANK, "tick", [-2, TICK_MAX + 1, None]),
    (BLANK, "newest", [-2, TICK_MAX + 1]),
    (BLANK, "margins", [bytes(2 * STATUSES_MAX + 2), bytes(3), ""]),
    (BLANK, "first", [-2, TICK_MAX + 1]),
    (BLANK, "statuses", [bytes(STATUSES_MAX + 1), ""]),
    (BLANK, "verdicts", [bytes(645), bytes(4), ""]),
    (BLANK, "drops", [bytes(12 * 4097), bytes(11)]),
    (Terrain(0, 0, 0, 0, 1, b""), "x", [-(1 << 23) - 1, 1 << 23, 0.0]),
    (Terrain(0, 0, 0, 0, 1, b""), "y", [-(1 << 23) - 1, 1 << 23]),
    (Terrain(0, 0, 0, 0, 1, b""), "z", [-(1 << 23) - 1, 1 << 23]),
    (Terrain(0, 0, 0, 0, 1, b""), "offset", [-1, 48 * 1024 + 1, None]),
    (Terrain(0, 0, 0, 0, 1, b""), "total", [0, 48 * 1024 + 1]),
    (Terrain(0, 0, 0, 0, 1, b""), "chunk", [bytes(48 * 1024 + 1), "chunk"]),
    (Pong(0.0, 0.0), "sent", [math.nan, None]),
    (Pong(0.0, 0.0), "tick", [math.inf, "0"]),
]


@pytest.mark.parametrize(("message", "field", "values"), OUT_OF_BOUNDS)
def test_a_field_beyond_its_bounds_is_refused_by_name(message: Message, field: str, values: list[Any]) -> None:
    for value in values:
        data = encode(message._replace(**{field: value}))
        with pytest.raises(ProtocolError, match=rf"{type(message).__name__}\.{field}|not MessagePack"):
            messages.decode(data, frozenset(KINDS), MESSAGE_MAX)


def test_every_field_has_a_case_beyond_its_bounds() -> None:
    tried = {(type(message), field) for message, field, _ in OUT_OF_BOUNDS}
    fields = {(kind, name) for kind, _ in KINDS.values() for name in kind._fields} - {(Snapshot, "segments")}
    assert tried == fields


@pytest.mark.parametrize("message", FROM_CLIENT + FROM_SERVER, ids=lambda message: type(message).__name__)
def test_a_field_too_many_or_too_few_is_refused(message: Message) -> None:
    parts = msgpack.unpackb(encode(message))
    if isinstance(message, Snapshot):
        assert_refused(msgpack.packb(parts[:7]), server=True)
        assert_refused(msgpack.packb([*parts[:8], *[PART] * 1025]), server=True)
        return
    for wrong in (parts[:-1], [*parts, 0]):  # (of a message without fields: without a kind)
        assert_refused(msgpack.packb(wrong))
        assert_refused(msgpack.packb(wrong), server=True)


HOSTILE = {
    "nothing": b"",
    "not a list": b"\x80",
    "an empty list": b"\x90",
    "an unknown kind": b"\x91\x63",
    "a kind that is true": b"\x92\x01\x01".replace(b"\x01", b"\xc3", 1),
    "a kind that is a float": msgpack.packb([3.0, 1.0]),
    "a kind that is a list": msgpack.packb([[3], 1.0]),
    "a reserved byte": b"\xc1",
    "trailing bytes": encode(Ping(1.0)) + b"\x00",
    "a list of four thousand million": b"\xdd\xff\xff\xff\xff",
    "a table of four thousand million": b"\x92\x01\xdf\xff\xff\xff\xff",
    "bytes without an end": b"\x94\x02\x00\x00\xc6\xff\xff\xff\xff",
    "text without an end": b"\x92\x03\xdb\xff\xff\xff\xff",
    "text that is not UTF-8": b"\x94\x01\x01\x80\xa2\xff\xfe",
    "a table with a table as key": b"\x94\x01\x01\x81\x80\x00\xa0",
    "an extension type": msgpack.packb([3, msgpack.ExtType(5, bytes(100))]),
    "a time": msgpack.packb([3, msgpack.Timestamp(1, 1)]),
    "a time that is none": b"\x92\x03\xd7\xff\xff\xff\xff\xff\xff\xff\xff\xff",
    "NaN": msgpack.packb([3, math.nan]),
}
HOSTILE |= {f"nested {depth} deep": b"\x92\x03" + b"\x91" * depth + b"\xc0" for depth in (100, 990, 1020, 1100, 8000)}
HOSTILE |= {
    f"tables nested {depth} deep": b"\x94\x01\x01" + b"\x81\xa0" * depth + b"\xc0\xa0" for depth in (100, 990, 1100)
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_bytes_are_refused(name: str) -> None:
    assert_refused(HOSTILE[name])
    assert_refused(HOSTILE[name], server=True)


def test_a_server_is_not_hurt_by_nesting_in_any_field() -> None:
    deep: Any = None
    for _ in range(500):
        deep = [deep]
    for message in FROM_CLIENT + FROM_SERVER:
        for field in set(message._fields) - {"segments"}:
            data = encode(message._replace(**{field: deep}))
            with pytest.raises(ProtocolError):
                messages.decode(data, frozenset(KINDS), MESSAGE_MAX)


def test_a_list_cannot_claim_memory_that_its_bytes_do_not_fill() -> None:
    # A thousand nested lists, each claiming the length of the message, would take 65 MB before the first is filled.
    for data, server in ((claims(CLIENT_MESSAGE_MAX), False), (claims(MESSAGE_MAX), True)):
        with pytest.raises(ProtocolError, match="not MessagePack"):
            (decode_from_server if server else decode_from_client)(data)
    for items, refused in ((CLIENT_LIST_MAX, "fields instead of"), (CLIENT_LIST_MAX + 1, "not MessagePack")):
        with pytest.raises(ProtocolError, match=refused):
            decode_from_client(msgpack.packb([3] * items))
    assert LIST_MAX > fields.SEGMENTS_MAX + 8


def claims(size: int) -> bytes:
    data = b"\x92\x03" + (b"\xdc" + min(size, 0xFFFF).to_bytes(2, "big")) * 1000
    return data + b"\xc0" * (size - len(data))


def test_of_two_equal_keys_the_last_counts() -> None:
    message = decode_from_client(b"\x96\x01\x01\x82\xa1a\xc4\x01\x01\xa1a\xc4\x01\x02\xa0\xa0\xc4\x00")
    assert message == Hello(1, {"a": b"\x02"}, "")


def test_a_message_that_is_too_long_is_not_even_looked_at() -> None:
    for decode, longest in ((decode_from_client, CLIENT_MESSAGE_MAX), (decode_from_server, MESSAGE_MAX)):
        with pytest.raises(ProtocolError, match=f"longer than {longest}"):
            decode(bytes(longest + 1))


def test_an_error_shows_little_of_what_was_sent() -> None:
    with pytest.raises(ProtocolError) as caught:
        decode_from_client(msgpack.packb([4, 1000, "x" * 8000, 0.0]))
    assert len(str(caught.value)) < 100


scalars = st.one_of(
    st.none(), st.booleans(), st.integers(-(1 << 63), (1 << 64) - 1), st.floats(), st.binary(max_size=40),
    st.text(max_size=40), st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=8)),
    st.integers(0, 1 << 33).map(msgpack.Timestamp),
)  # fmt: skip
keys = st.one_of(st.text(max_size=8), st.binary(max_size=8), st.integers(-9, 9))
structures = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=8) | st.dictionaries(keys, inner, max_size=4), max_leaves=12
)
near_misses = st.builds(
    lambda kind, fields: [kind, *fields], st.sampled_from(sorted(KINDS)), st.lists(structures, max_size=9)
)
JOINED = [
    join_snapshot((9, 12, b"\x01\x02", 8, b"\x00", b"", b""), 2, msgpack.packb(PART) * 2),
    join_snapshot((TICK_MAX, -1, bytes(4), -1, bytes(256), b"", b""), 0, b""),
]
"""Encoded messages that the fast decoder handles."""
valid = st.sampled_from([encode(message) for message in FROM_CLIENT + FROM_SERVER] + JOINED * 4)


@st.composite
def mutated(draw: st.DrawFn) -> bytes:
    """Returns a valid message that is cut off, or has flipped, inserted or deleted bytes."""
    data = bytearray(draw(valid))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        match draw(st.sampled_from(["cut", "flip", "insert", "delete", "set"])):
            case "cut":
                del data[at:]
            case "flip" if data:
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "insert":
                data[at:at] = draw(st.binary(max_size=6))
            case "delete":
                del data[at : at + draw(st.integers(1, 6))]
            case "set" if data:
                data[at] = draw(st.sampled_from([0xC0, 0xC1, 0xC6, 0xCB, 0xD6, 0xDB, 0xDC, 0xDD, 0xDF, 0xFF]))
    return bytes(data)


@settings(max_examples=examples(300))
@given(st.one_of(st.binary(max_size=300), (structures | near_misses).map(msgpack.packb), mutated()))
def test_any_bytes_are_a_message_or_a_protocol_error(data: bytes) -> None:
    for decode in (decode_from_client, decode_from_server):
        with contextlib.suppress(ProtocolError):
            message = decode(data)
            # A decoded message is within all bounds: it can be encoded again, and is decoded to the same.
            assert decode(encode(message)) == message


def outcome(decode: Callable[[], Message]) -> Message | str:
    """Returns the decoded message, or the text of the error."""
    try:
        return decode()
    except ProtocolError as error:
        return str(error)


@settings(max_examples=examples(300))
@given(mutated())
def test_the_short_ways_decide_as_the_long_one(data: bytes) -> None:
    by_client = outcome(lambda: messages.decode(data, CLIENT_KINDS, CLIENT_MESSAGE_MAX, CLIENT_LIST_MAX))
    assert repr(outcome(lambda: decode_from_client(data))) == repr(by_client)
    by_server = outcome(lambda: messages.decode(data, SERVER_KINDS, MESSAGE_MAX))
    assert repr(outcome(lambda: decode_from_server(data))) == repr(by_server)


@pytest.mark.parametrize("field", Snapshot._fields[:7])
def test_a_joined_snapshot_beyond_its_bounds_is_refused_by_name(field: str) -> None:
    values = next(values for message, name, values in OUT_OF_BOUNDS if message == BLANK and name == field)
    for value in [*values, True, 1.0, []]:
        with pytest.raises(ProtocolError, match=rf"Snapshot\.{field}|not MessagePack"):
            decode_from_server(join_snapshot(BLANK._replace(**{field: value})[:7], 1, msgpack.packb(PART)))
    with pytest.raises(ProtocolError, match="fields instead of"):
        decode_from_server(join_snapshot(BLANK[:7], 1025, b"\x00" * 1025))


def assert_refused(data: bytes, *, server: bool = False) -> None:
    with pytest.raises(ProtocolError):
        (decode_from_server if server else decode_from_client)(data)


@pytest.mark.parametrize("row_bytes", [3, 9])
def test_rows_of_inputs_have_the_length_of_the_scene(row_bytes: int) -> None:
    for size in (*range(80), *range(180, 200), *range(570, 600)):
        message = Inputs(5, 4, bytes(size))
        if size % row_bytes == 0 and size <= 64 * row_bytes:
            assert messages.decode_from_client(encode(message), row_bytes) == message
        else:
            with pytest.raises(ProtocolError, match=r"Inputs\.rows"):
                messages.decode_from_client(encode(message), row_bytes)


def test_what_clients_sent_before_there_was_an_aim_is_what_it_was() -> None:
    """Bytes of clients of protocol version 3 from before scenes could have buttons and an aim."""
    hello = bytes.fromhex("96010380a3416e6ea0c400")
    assert messages.decode_from_client(hello) == Hello(3, {}, "Ann")
    inputs = bytes.fromhex("9402cd03fdcd03fac4067f00007f0001")
    assert messages.decode_from_client(inputs) == Inputs(1021, 1018, bytes((127, 0, 0, 127, 0, 1)))
    assert encode(Inputs(1021, 1018, b"".join((row(Input(127)), row(Input(127, 0, 1)))))) == inputs
