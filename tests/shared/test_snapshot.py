"""A segment's part in a snapshot: lossless for any legal state, and refused if it could harm a world."""

import hashlib
import random
import zlib
from itertools import pairwise
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import kernels
from shared.blocks import BLOCKS, pack, unpack
from shared.checks import Cell
from shared.fields import ENTITY_MAX, PACKED_MAX, TICK_MAX
from shared.inputs import Input
from shared.layout import (
    CELL,
    EDGE_HIGH,
    FALLING,
    FLAGS,
    ID,
    MOVE_X,
    NEW_BUTTONS,
    NEW_MOVE,
    STOP_X,
    STOP_Y,
    TEMPLATE,
    TOLD,
    TURN,
    VX,
    WHOLE,
    X,
)
from shared.messages import ProtocolError
from shared.snapshot import (
    ACTED,
    PLACED,
    ROW,
    SIDE,
    DecodedDelta,
    checksum,
    decode_parts,
    encode_part,
    encode_rows,
)
from tests.packed_turns import pack_turns, unpack_turns
from tests.worlds import build

FAR = (1 << 23) - 1
SPEED_EXTREME = 1 << 30
State = tuple[int, ...]
FORMS = [kernels.get(False), *([kernels.get(True)] if kernels.available() else [])]
TURNS = pack_turns([[1, TOLD | NEW_MOVE | STOP_Y, 127, 0, 0, 0, 5, 0]])
"""The turn of an entity that got another direction and stopped: 8 bytes."""


def sent(
    segment: Cell,
    states: list[State],
    ago: int = 5,
    gone: list[int] | None = None,
    edits: list[tuple[int, int]] | None = None,
) -> tuple[DecodedDelta, list[State]]:
    """Returns a part and its states as a peer decodes them."""
    rows = np.array(states, np.int64).reshape(-1, CELL)
    part = msgpack.unpackb(encode_part(segment, ago, rows, gone or [], edits or [], check=9))
    parts, decoded, _ = decode_parts([part], 255)
    return parts[0], [tuple(row) for row in decoded.tolist()]


def low_corner(segment: Cell) -> list[int]:
    return [place * SIDE for place in segment]


def state_in(segment: Cell, inside: int, velocity: int, move: int, entity: int = 1, **_: Any) -> State:
    x, y, z = (low + inside for low in low_corner(segment))
    return (entity, 254, 1, x, y, z, velocity, -velocity, velocity, move, -move, 255)


def part_of(**fields: Any) -> list[Any]:
    """Returns a legal part with some fields changed."""
    row = encode_rows(np.array([state_in((0, 0, 0), 5, 6, 7)], np.int64))
    values: dict[str, Any] = {"x": 0, "y": 0, "z": 0, "ago": 1, "turns": TURNS, "rows": row}
    values |= {"gone": b"\x01\0\0\0", "check": 0, "edits": b"\0\0\x01", "attributes": [1, {"name": "Ann"}]}
    return list((values | fields).values())


def row_with(column: int, value: int) -> bytes:
    """Returns a packed row in which one field has a value that no state has."""
    values = list(ROW.unpack(part_of()[5]))
    values[column] = value
    return ROW.pack(*values)


def test_a_row_is_33_bytes() -> None:
    assert ROW.size == 33


@pytest.mark.parametrize("segment", [(0, 0, 0), (-1, -1, -1), (FAR, -FAR - 1, FAR), (-FAR - 1, FAR, 0)])
@pytest.mark.parametrize("inside", [0, 1, SIDE // 2, SIDE - 1])
def test_extreme_states_come_out_as_they_went_in(segment: Cell, inside: int) -> None:
    for velocity in (0, -1, SPEED_EXTREME, -SPEED_EXTREME):
        for move in (0, 127, -127):
            for entity in (1, ENTITY_MAX):
                state = state_in(segment, inside, velocity, move, entity)
                assert sent(segment, [state])[1] == [state]


cells = st.tuples(*[st.integers(-FAR - 1, FAR)] * 3)
states = st.tuples(
    st.integers(1, ENTITY_MAX), st.integers(0, 254), st.integers(0, 1), *[st.integers(0, SIDE - 1)] * 3,
    *[st.integers(-SPEED_EXTREME, SPEED_EXTREME)] * 3, *[st.integers(-127, 127)] * 2, st.integers(0, 255),
)  # fmt: skip


@given(
    cells,
    st.integers(-1, TICK_MAX),
    st.lists(states, max_size=5),
    st.lists(st.integers(0, (1 << 32) - 1), max_size=5),
    st.lists(st.tuples(st.integers(0, BLOCKS - 1), st.integers(0, 255)), max_size=5),
)
def test_any_legal_part_is_lossless(
    segment: Cell, ago: int, inside: list[State], gone: list[int], edits: list[tuple[int, int]]
) -> None:
    corner = low_corner(segment)
    absolute = [(*s[:X], *(low + part for low, part in zip(corner, s[X:VX], strict=True)), *s[VX:]) for s in inside]
    part, decoded = sent(segment, absolute, ago, gone, edits)
    assert decoded == absolute
    assert (part.segment, part.ago, part.entities, part.gone, part.check) == (segment, ago, len(inside), gone, 9)
    assert part.edits == edits


def test_parts_share_one_table_of_states_and_each_has_its_own_corner(compiled: bool) -> None:
    segments = [(0, 0, 0), (-2, 1, 3), (5, 5, -5)]
    tables = [[state_in(s, 9, 1, 2, 10 * i + j) for j in range(i)] for i, s in enumerate(segments)]
    encoded = [
        msgpack.unpackb(encode_part(s, -1, np.array(t, np.int64).reshape(-1, CELL), [], []))
        for s, t in zip(segments, tables, strict=True)
    ]
    parts, decoded, _ = decode_parts(encoded, 255, kernels.get(compiled))
    assert [part.entities for part in parts] == [0, 1, 2]
    assert [tuple(row) for row in decoded.tolist()] == [state for table in tables for state in table]


def test_no_parts_are_no_states() -> None:
    parts, decoded, turns = decode_parts([], 1)
    assert (parts, decoded.shape, turns.shape) == ([], (0, CELL), (0, TURN))


def test_bookkeeping_of_a_process_does_not_travel() -> None:
    row = np.array([[*state_in((0, 0, 0), 1, 0, 0)[:2], 0b11, 0, 0, 0, 0, 0, 0, 0, 0, 0, 77, 78, 79, 80]], np.int64)
    parts, decoded, _ = decode_parts([msgpack.unpackb(encode_part((0, 0, 0), 0, row, [], []))], 255)
    assert decoded.tolist() == [[1, 254, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]]
    assert parts[0].entities == 1


def test_only_entities_that_the_rules_acted_on_are_flagged() -> None:
    rows = np.array([state_in((0, 0, 0), 1, 0, 0, entity) for entity in (3, 5, 8)], np.int64)
    _, decoded, _ = decode_parts([msgpack.unpackb(encode_part((0, 0, 0), 0, rows, acted={5, 9}))], 255)
    assert [flags & ACTED for flags in decoded[:, FLAGS].tolist()] == [0, ACTED, 0]
    assert (decoded[:, FLAGS] & FALLING).tolist() == [1, 1, 1]


def test_a_placed_entity_is_flagged_as_acted_upon_too() -> None:
    rows = np.array([state_in((0, 0, 0), 1, 0, 0, entity) for entity in (3, 5, 8)], np.int64)
    part = msgpack.unpackb(encode_part((0, 0, 0), 0, rows, acted={3}, placed={8, 9}))
    _, decoded, _ = decode_parts([part], 255)
    assert decoded[:, FLAGS].tolist() == [FALLING | ACTED, FALLING, FALLING | ACTED | PLACED]


def test_a_checksum_is_that_of_the_blocks_and_the_rows_ascending_by_id(compiled: bool) -> None:
    rng = random.Random(4)
    world = build([[-9, -9, -32, 9, 9, -31, 3]], compiled=compiled)
    segments = sorted(world.blocks)
    for entity in range(1, 120):
        world.spawn("ghost", (rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(-28, 28)))
        if entity % 3 == 0:
            world.remove(entity - 1)
        world.step({entity: Input(rng.randint(-127, 127), -1, 1)})
        segment = segments[entity % len(segments)]
        rows = world.in_segment(segment)
        digest = hashlib.sha256(world.blocks.segment(segment).tobytes()).digest()[:16]
        check = hashlib.sha256(digest + encode_rows(rows)).digest()[:4]
        assert checksum(world, segment) == int.from_bytes(check, "little")
    assert min(len(world.in_segment(segment)) for segment in segments) > 1


def test_a_checksum_is_of_all_a_segment_holds_and_of_nothing_else() -> None:
    world, other = build(), build()
    for each in (world, other):
        each.spawn("box", (1, 1, 1))
        each.spawn("box", (-9, 1, 1))
    first = checksum(world, (0, 0, 0))
    assert first == checksum(other, (0, 0, 0)) > 0
    other.place(2, (-12, 1, 1))  # elsewhere
    assert first == checksum(other, (0, 0, 0))
    other.set_block(3, 3, 3, 1)
    changed = checksum(other, (0, 0, 0))
    assert changed != first
    other.set_velocity(1, (0, 0, 1))
    assert checksum(other, (0, 0, 0)) not in (first, changed)


@pytest.mark.parametrize(
    "fields",
    [
        {"x": FAR + 1}, {"y": -FAR - 2}, {"z": 1 << 63}, {"x": True}, {"y": 0.0}, {"z": None}, {"x": "0"},
        {"ago": -2}, {"ago": 1 << 53}, {"ago": False}, {"ago": None}, {"ago": 2},
        {"turns": "turns"}, {"turns": [1]}, {"turns": 7}, {"turns": None}, {"turns": bytes(200 * 1024 + 1)},
        {"rows": bytes(32)}, {"rows": ""}, {"rows": None}, {"rows": []}, {"rows": bytes(33 * 7000)},
        {"gone": bytes(3)}, {"gone": "gone"}, {"gone": [1]}, {"gone": bytes(4 * 60_000)},
        {"check": -1}, {"check": 1 << 32}, {"check": True}, {"check": None},
        {"attributes": None}, {"attributes": [1]}, {"attributes": [0, {}]}, {"attributes": [1 << 31, {}]},
        {"attributes": [True, {}]}, {"attributes": [1, []]}, {"attributes": [1, {b"name": 1}]},
        {"edits": bytes(4)}, {"edits": {}}, {"edits": b"\x00\x80\x01"}, {"edits": b"\xff\xff\x00"},
    ],
    ids=lambda fields: f"{fields}"[:30],
)  # fmt: skip
def test_a_part_beyond_its_bounds_is_refused(fields: dict[str, Any]) -> None:
    decode_parts([part_of()], 255)
    with pytest.raises(ProtocolError, match="segment"):
        decode_parts([part_of(), part_of(**fields)], 255)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        (ID, 0), (ID, 1 << 31), (ID, (1 << 32) - 1), (TEMPLATE, 255), (2, 8), (2, 255),
        *[(X + axis, value) for axis in range(3) for value in (-1, SIDE, -(1 << 31), (1 << 31) - 1)],
        *[(VX + axis, value) for axis in range(3) for value in (SPEED_EXTREME + 1, -SPEED_EXTREME - 1, -(1 << 31))],
        (MOVE_X, -128), (MOVE_X + 1, -128),
    ],
)  # fmt: skip
def test_a_state_that_no_world_has_is_refused(column: int, value: int, compiled: bool) -> None:
    with pytest.raises(ProtocolError, match=r"segment\.rows"):
        decode_parts([part_of(), part_of(rows=part_of()[5] + row_with(column, value))], 255, kernels.get(compiled))


def test_a_template_is_one_of_the_scene(compiled: bool) -> None:
    decode_parts([part_of(rows=row_with(TEMPLATE, 2))], 3, kernels.get(compiled))
    with pytest.raises(ProtocolError, match=r"segment\.rows"):
        decode_parts([part_of(rows=row_with(TEMPLATE, 3))], 3, kernels.get(compiled))


@pytest.mark.parametrize(
    "packed",
    [
        *[TURNS[:n] for n in range(1, len(TURNS))],  # cut off
        b"\x40",  # the gap goes on
        b"\x7f\x80\x80\x80\x80\x01\x01\x01",  # a gap of too many bytes
        b"\x7f\xff\xff\xff\x7f\x01\x01",  # an id beyond the greatest one
        b"\x80",  # no events
        *[bytes((0x80, STOP_X, first, 0, 0, 0)) for first in (64, 127, 160, 255)],  # an unknown kind of stop
        *[bytes((0x80, STOP_X << axis, 128, 0, 0)) for axis in range(3)],  # a place of two bytes
        bytes((0x80, TOLD | NEW_BUTTONS)),
        bytes((0x80, TOLD | NEW_MOVE | NEW_BUTTONS, 1, 2)),
    ],
    ids=bytes.hex,
)
def test_malformed_turns_are_refused_wherever_they_stand(packed: bytes, compiled: bool) -> None:
    kernel = kernels.get(compiled)
    for turns in (packed, TURNS + packed):
        for parts in ([turns], [TURNS, turns], [turns, TURNS], [turns, b"", turns]):
            with pytest.raises(ProtocolError, match=r"segment\.turns"):
                decode_parts([part_of(turns=each) for each in parts], 255, kernel)


places = st.integers(0, SIDE - 1) | st.integers(-2 * EDGE_HIGH, -1)
turn_lists = st.dictionaries(
    st.integers(1, ENTITY_MAX) | st.integers(1, 200),
    st.tuples(st.integers(0, WHOLE - 1), *[st.integers(-128, 127)] * 2, st.integers(0, 255), *[places] * 3),
    max_size=9,
).map(lambda found: [[entity, *rest] for entity, rest in sorted(found.items())])


def sent_of(turn: list[int]) -> list[int]:
    """Returns a turn with the numbers that its events need."""
    entity, events, move_x, move_y, buttons, *stops = turn
    new = events if events & TOLD else 0
    moves = [move_x, move_y] if new & NEW_MOVE else [0, 0]
    found = [place if events & STOP_X << axis else 0 for axis, place in enumerate(stops)]
    return [entity, events, *moves, buttons if new & NEW_BUTTONS else 0, *found]


@given(st.lists(turn_lists, min_size=1, max_size=4))
def test_any_turns_are_lossless(lists: list[list[list[int]]]) -> None:
    told = [sent_of(turn) for turns in lists for turn in turns]
    parts = [part_of(turns=pack_turns(turns), rows=b"") for turns in lists]
    for kernel in FORMS:
        _, _, turns = decode_parts(parts, 255, kernel)
        assert turns.tolist() == told
    assert [turn for part in parts for turn in unpack_turns(part[4])] == told


@given(turn_lists, st.integers(0, 200), st.binary(max_size=3))
def test_cut_or_changed_turns_give_turns_or_a_protocol_error(found: list[list[int]], at: int, instead: bytes) -> None:
    """All forms of the kernel agree. The ids ascend, and a hostile server gets no other value through."""
    packed = pack_turns(found)
    packed = packed[:at] + instead + packed[at + 3 :]
    results = []
    for kernel in FORMS:
        try:
            results.append(decode_parts([part_of(turns=packed, rows=b"")], 255, kernel)[2].tolist())
        except ProtocolError:
            results.append(None)
    assert all(result == results[0] for result in results)
    ids = [0] + [turn[0] for turn in results[0] or ()]
    assert all(low < high <= ENTITY_MAX for low, high in pairwise(ids))
    assert all(-2 * EDGE_HIGH <= place < SIDE for turn in results[0] or () for place in turn[5:])


def test_nesting_a_thousand_deep_is_refused_like_anything_else() -> None:
    deep: Any = None
    for _ in range(1000):
        deep = [deep]
    for name in ("x", "ago", "turns", "rows", "gone", "edits", "check"):
        with pytest.raises(ProtocolError):
            decode_parts([part_of(**{name: deep})], 255)


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.binary(max_size=70) | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(max_size=4), inner, max_size=2),
    max_leaves=9,
)
field = st.sampled_from(["x", "y", "z", "ago", "turns", "rows", "gone", "edits", "check"])


@given(st.lists(st.one_of(anything, st.dictionaries(field, anything, max_size=2).map(lambda f: part_of(**f)))))
def test_any_value_is_a_part_or_a_protocol_error(segments: list[Any]) -> None:
    try:
        parts, decoded, _ = decode_parts(segments, 3)
    except ProtocolError:
        return
    assert sum(part.entities for part in parts) == len(decoded)


# -- terrain -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_a_segment_is_packed_and_unpacked_without_loss(seed: int) -> None:
    kinds = np.random.default_rng(seed).integers(0, (2, 5, 256)[seed], BLOCKS).astype(np.uint8)
    packed = pack(kinds)
    assert len(packed) <= PACKED_MAX
    assert (unpack(packed) == kinds).all()


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\0" * 40, b"not zlib at all",
        zlib.compress(bytes(BLOCKS - 1)), zlib.compress(bytes(BLOCKS + 1)), zlib.compress(b""),
        zlib.compress(bytes(BLOCKS))[:-1], zlib.compress(bytes(BLOCKS)) + b"\0",
        zlib.compress(bytes(16 << 20)),  # 16 KB that would unpack to 16 MB
        zlib.compress(zlib.compress(bytes(BLOCKS))),
        bytes(PACKED_MAX + 1),
    ],
)  # fmt: skip
def test_what_is_not_one_packed_segment_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="packed segment"):
        unpack(data)


@given(st.binary(max_size=80), st.integers(0, 60), st.integers(0, 7))
def test_any_bytes_unpack_to_a_segment_or_a_value_error(data: bytes, at: int, bit: int) -> None:
    flipped = bytearray(pack(np.arange(BLOCKS, dtype=np.uint64).astype(np.uint8)))
    flipped[at % len(flipped)] ^= 1 << bit
    for candidate in (data, bytes(flipped)):
        try:
            assert len(unpack(candidate)) == BLOCKS
        except ValueError:
            continue
