"""docs/protocol.md compared with the code: each example byte by byte, and each table."""

import inspect
import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from shared import bounds as bounds_module
from shared import bulk, edits, fields, layout, messages, payloads
from shared.blocks import offset_of, pack, unpack
from shared.bounds import bounds
from shared.messages import KINDS, Message, Snapshot, decode_from_client, decode_from_server, encode, join_snapshot
from shared.snapshot import FIELDS, ROW, decode_parts
from tests.packed_turns import pack_turns

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "protocol.md").read_text("utf-8")
SEGMENT = ("segment", "x", "y", "z", "ago", "turns", "rows", "gone", "check", "edits", "attributes", "fields")
DECODE = {"client": decode_from_client, "server": decode_from_server}


def blocks(kind: str) -> list[tuple[str, str]]:
    """Returns the fenced blocks of a kind: the text after its name, and the text inside."""
    found: list[tuple[str, str]] = re.findall(rf"^```{kind} ?(\w*)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return found


def lines(text: str) -> list[tuple[bytes, str]]:
    """Returns bytes and note of each line. Bytes without a note belong to the line before."""
    found: list[tuple[bytes, str]] = []
    for line in text.splitlines():
        digits, _, note = line.partition("   ")
        raw = bytes.fromhex(digits)
        if note.strip():
            found.append((raw, note.strip()))
        else:
            found[-1] = (found[-1][0] + raw, found[-1][1])
    return found


def table(*heads: str) -> list[list[str]]:
    """Returns the cells of each row of the one table that begins with these headings."""
    pattern = re.escape("| " + " | ".join(heads)) + r".*\n\|[-|]+\n((?:\|.*\n)+)"
    (found,) = re.findall(pattern, PAGE)
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", row.strip("|"))] for row in found.splitlines()]


def message(text: str, side: str) -> Message:
    return DECODE[side](b"".join(raw for raw, _ in lines(text)))


def again(decoded: Message) -> bytes:
    """Returns a message encoded as its sender does."""
    if isinstance(decoded, Snapshot):
        return join_snapshot(decoded[:7], len(decoded.segments), b"".join(map(msgpack.packb, decoded.segments)))
    return encode(decoded)


def names(decoded: Message) -> Iterator[str]:
    if not isinstance(decoded, Snapshot):
        yield from decoded._fields
    else:
        yield from decoded._fields[:-1]
        for segment in decoded.segments:
            yield from SEGMENT[: 1 + len(segment)]


EXAMPLES = [pytest.param(side, text, id=type(message(text, side)).__name__) for side, text in blocks("wire")]


@pytest.mark.parametrize(("side", "text"), EXAMPLES)
def test_an_example_is_what_the_code_reads_and_writes(side: str, text: str) -> None:
    decoded = message(text, side)
    told = lines(text)
    assert again(decoded) == b"".join(raw for raw, _ in told)
    (_, kind), *fields = told
    assert KINDS[int(kind.removeprefix("kind "))][0] is type(decoded)
    assert [note.partition(" = ")[0] for _, note in fields] == list(names(decoded))
    for raw, note in fields:
        name, equals, value = note.partition(" = ")
        if equals:
            found = msgpack.unpackb(raw)
            assert (found, type(found)) == (json.loads(value), type(json.loads(value))), name


def test_every_kind_has_an_example_and_a_row() -> None:
    shown = {type(message(text, side)) for side, text in blocks("wire")}
    assert shown == {kind for kind, _ in KINDS.values()}
    rows = [pair for row in table("kind", "client sends") for pair in (row[:3], row[3:])]
    told = {(int(kind), name, fields) for kind, name, fields in rows if kind}
    assert told == {(number, kind.__name__, " ".join(kind._fields)) for number, (kind, _) in KINDS.items()}
    assert {int(row[0]) for row in table("kind", "client sends") if row[0]} == messages.CLIENT_KINDS
    assert {int(row[3]) for row in table("kind", "client sends")} == messages.SERVER_KINDS


def example(kind: type[Any]) -> Any:
    return next(found for side, text in blocks("wire") if isinstance(found := message(text, side), kind))


def test_the_snapshot_example_is_as_described() -> None:
    snapshot = example(Snapshot)
    assert (np.frombuffer(snapshot.margins, "<i2") / bounds(32).margin_one).tolist() == [2.5, -0.25, 2.0]
    assert snapshot.newest == 1021
    assert list(snapshot.statuses) == [messages.USED, messages.REPEATED]
    (part,), states, turns = decode_parts(snapshot.segments, 1)
    plain, stops = layout.TOLD | layout.NEW_MOVE, layout.STOP_X | layout.STOP_Z
    assert turns.tolist() == [[12, plain, 0, 127, 0, 0, 0, 0], [15, plain | stops, 127, 0, 0, 21 << 23, 0, -1 - 12]]
    said = [bytes.fromhex(raw.strip("`")) for raw, _ in table("bytes", "of the example")]
    assert b"".join(said) == snapshot.segments[0][4] == pack_turns(turns.tolist())
    kinds = [int(bits) << 5 for bits, _ in table("bits 5 to 7", "the entity stops")]
    assert kinds == [0, layout.EDGE_HIGH, bulk.WITHIN]
    assert (part.gone, [block for block, _ in part.edits]) == ([9], [0x33E3])
    assert offset_of(3, 31, 12) == 0x33E3
    ((_, text),) = blocks("row")
    packed = b"".join(raw for raw, _ in lines(text))
    assert packed == snapshot.segments[0][5]
    told = [note.split(" = ") for _, note in lines(text)]
    assert [len(raw) for raw, _ in lines(text)] == [struct.calcsize(kind) for kind in "IBBiiiiiibbB"]
    assert [(name, int(value)) for name, value in told] == list(zip(FIELDS, ROW.unpack(packed), strict=True))
    x, y, z = (states[0, 3:6] / 2**24).tolist()
    assert (x, y, z, states[0, 6] / 2**16) == (259.5, 252.25, 12.0, 3.0)


def test_the_terrain_example_is_as_described() -> None:
    kinds = unpack(example(messages.Terrain).chunk)
    ((_, text),) = blocks("terrain")
    told = {int(at): int(kind) for at, kind in re.findall(r"byte (\d+) is (\d+)\n", text)}
    assert len(told) == len(text.splitlines())
    assert {at: int(kinds[at]) for at in told} == told
    assert kinds[offset_of(3, 4, 1)] == 3
    assert unpack(pack(kinds)).tobytes() == kinds.tobytes()


def test_payloads() -> None:
    assert edits.unpack(example(messages.Command).payload) == (259, 255, 12, 0)
    assert payloads.unpack_value(example(messages.Happened).payload) == {"by": 7}
    assert example(messages.Inputs).rows == bytes((127, 0, 0, 127, 0, 1))


def test_tables_of_numbers() -> None:
    statuses = {name: int(number) for number, name, _ in table("fate", "name")}
    assert statuses == {name: getattr(messages, name) for name in ("USED", "REPEATED", "NEUTRALISED", "IDLE")}
    assert [text for _, text in table("verdict", "meaning")] == list(messages.VERDICT_TEXTS)
    assert [int(number) for number, _ in table("verdict", "meaning")] == list(range(len(messages.VERDICT_TEXTS)))
    codes = {name: int(number) for number, name, _ in table("code", "name")}
    assert codes == {name: getattr(messages, name) for name in codes}
    source = inspect.getsource(messages)
    listed = re.findall(r"^([A-Z_, ]+) = (?:1001, |range\(4001, |range\(4009, )", source, re.MULTILINE)
    assert {name for names in listed for name in names.split(", ")} == codes.keys()
    limits = {name: int(value) for name, value, _ in table("limit", "value")}
    assert limits == {name: getattr(fields, name) for name in limits}
    times = {name: float(value) for name, value, _ in table("time", "seconds")}
    assert times == {name: getattr(bounds_module, name) for name in times}
    events = {name: 1 << int(bit) for bit, name, _ in table("bit", "event")}
    assert events == {name: getattr(layout, name) for name in events}
    assert sum(events.values()) == layout.WHOLE - 1
    assert [name.strip("`") for name, _ in table("field", "meaning")] == [*SEGMENT[4:]]
