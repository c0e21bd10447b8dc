"""Recordings: all calls, at any time, with any kind of damage."""

import io
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.config.options import SettingsError
from server.journal import former
from server.journal.recorded_world import Observer, RecordedWorld
from server.journal.records import (
    FILL,
    MAGIC,
    NOTE,
    PUT,
    REMOVE,
    DivergedError,
    JournalError,
    Moment,
    Recording,
    input_record,
    recorded_inputs,
    redo,
    replay,
)
from server.runtime import keeping
from shared.aim import NO_AIM, make_aim
from shared.inputs import Input
from shared.world import OverlapError, World
from shared.world_state import WorldState
from tests import worlds
from tests.lengths import examples

FORMER = Path(__file__).parent.parent / "golden" / "former"
"""Files of the program at 2db46f5: a recording in format 2, and a saved world in schema version 2."""
FLOOR = [worlds.floor(0)]


def recorded(file: io.BytesIO) -> RecordedWorld:
    """Returns a world with a floor, two movers and a stone, recorded from tick 3 on."""
    world = RecordedWorld(worlds.scene(FLOOR))
    world.load_terrain()
    world.set_block(5, 5, 0, 9)
    for place in ((0, 0, 0), (4, 0, 0), (0, 4, 0.5)):
        world.spawn("box", place)
    world.remove(3)
    worlds.steps(world, 3, {1: worlds.EAST})
    world.spawn("stone", (8, 8, 3))  # changed before the first recorded step
    world.record(file)
    return world


def read(data: bytes) -> tuple[list[Moment], Recording]:
    recording = Recording(io.BytesIO(data))
    return list(recording), recording


def play(world: RecordedWorld) -> list[bytes]:
    """Makes calls of every kind. Returns the hash after each tick."""
    hashes = []

    def step(inputs: dict[int, Input] | None = None) -> None:
        world.step(inputs)
        hashes.append(world.state_hash())

    for tick in range(40):
        step({1: worlds.NORTH if tick < 20 else worlds.SOUTH, 2: Input(tick % 3, 0, tick % 2)})
    world.set_block(2, 2, 0, 1)
    with pytest.raises(OverlapError):
        world.fill((-30, -30, 0), (30, 30, 1), 1)
    world.fill((3, 0, 0), (6, 2, 1), 2, push=True)
    step({1: worlds.EAST})
    ghost = world.spawn("ghost", (10, 10, 4), (1, 2, 3))
    world.set_template(ghost, "cube")
    step()
    world.place(2, (12, 12, 2), push=True)
    world.set_velocity(2, (0, 0, 5))
    step({2: worlds.JUMP})
    world.remove(1)
    world.write_blocks((0, 0, 0), [0, 33], [7, 0])
    step()
    world.load_segment((3, 0, 0), world.blocks.segment((0, 0, 0)).reshape(-1))
    world.unload_segment((-1, -1, -1))
    world.load_terrain([(-1, -1, -1)])
    step()
    world.spawn_many("box", [(-20, -20, 5), (-16, -20, 0), (-12, -20, 1)])
    with pytest.raises(OverlapError):
        world.spawn_many("box", [(-8, -20, 0), (-8, -20, 0.5)])
    step()
    world.rebase(1000)
    step()
    world.spawn("box", (20, 20, 2))
    return hashes


def test_every_call_is_replayed_to_the_same_hash_at_every_tick() -> None:
    file = io.BytesIO()
    world = recorded(file)
    hashes = play(world)
    world.end_recording()
    recording = Recording(io.BytesIO(file.getvalue()))
    assert (recording.world.tick, recording.scene) == (3, world.scene)
    found, last = [], None
    for moment in recording:
        if not moment.ended:
            found.append(moment.world.state_hash())
        last = moment
    assert found == hashes
    assert last is not None
    assert last.ended
    assert last.hashed
    assert last.world.state_hash() == world.state_hash()
    assert recording.world.next_id == world.next_id == 10
    assert recording.torn == 0


def test_the_id_after_the_last_is_kept_even_if_its_owner_is_gone() -> None:
    file = io.BytesIO()
    world = RecordedWorld(worlds.scene(FLOOR))
    world.load_terrain()
    world.remove(world.spawn("box", (0, 0, 0)))
    world.record(file)
    assert read(file.getvalue())[1].world.next_id == 2


def test_held_inputs_are_written_once_and_again_after_a_teleport() -> None:
    file = io.BytesIO()
    world = recorded(file)
    world.step({1: worlds.EAST, 2: worlds.JUMP})
    before = len(file.getvalue())
    world.step({1: worlds.EAST, 2: worlds.JUMP})
    assert len(file.getvalue()) - before < 25  # 12 of them are the frame
    world.place(1, (0, 20, 1))
    world.step({1: worlds.EAST, 2: worlds.JUMP})
    moments, _ = read(file.getvalue())
    assert [moment.inputs for moment in moments] == [{1: worlds.EAST, 2: worlds.JUMP}, {}, {1: worlds.EAST}]
    assert [[call[0] for call in moment.calls] for moment in moments] == [[], [], [PUT]]


@pytest.mark.parametrize("aim", [False, True])
def test_inputs_are_recorded_with_an_aim_where_the_scene_has_one(aim: bool) -> None:
    file = io.BytesIO()
    world = RecordedWorld(worlds.scene(FLOOR, aim=aim), compiled=False)
    world.load_terrain()
    for place in ((0, 0, 0), (4, 0, 0)):
        world.spawn("box", place)
    world.record(file)
    aims = [make_aim((1, tick // 4, -3)) if aim else NO_AIM for tick in range(16)]
    for tick in range(16):
        plain: Any = (tick // 8, -5, 3)  # a tuple without an aim is an input, too
        world.step({1: Input(127, 0, 1, aims[tick]), 2: plain})
    world.end_recording()
    moments, recording = read(file.getvalue())
    assert recording.world.state_hash() == world.state_hash()
    for tick, moment in enumerate(moments[:-1]):
        new = {2: Input(tick // 8, -5, 3)} if tick % 8 == 0 else {}
        if tick == 0 or aims[tick] != aims[tick - 1]:
            new[1] = Input(127, 0, 1, aims[tick])
        assert moment.inputs == new


def test_an_input_record_of_a_scene_without_aim_is_what_it_was() -> None:
    """Numbers of records from before there was an aim."""
    input_ = Input(-5, 127, 3)
    assert input_record(7, input_, aim=False) == [7, -5, 127, 3]
    assert recorded_inputs([7, -5, 127, 3, 9, 0, 0, 0], aim=False) == {7: input_, 9: Input()}
    assert input_record(7, input_, aim=True) == [7, -5, 127, 3, 0, 0, 0]
    for numbers in ([7], [7, 0, 0, 0, 9], [7, 0, 0, 256], [7, 0, 0, "1"]):
        with pytest.raises((ValueError, TypeError)):
            recorded_inputs(numbers, aim=False)  # type: ignore[arg-type]
    for short in ([7, 0, 0, 0, 1, 2], [7, 0, 0, 0, 1, 1 << 40, 0]):
        with pytest.raises(ValueError, match=r"."):
            recorded_inputs(short, aim=True)


def test_notes_come_back_in_order_among_the_calls() -> None:
    file = io.BytesIO()
    world = recorded(file)
    told = {"who": ["Ann", None, 1.5, b"\0"], 7: True}
    world.note(told)
    world.remove(2)
    told["who"] = "changed too late"
    world.note("left")
    world.step()
    world.step()
    first, second = read(file.getvalue())[0]
    assert first.calls == [[NOTE, msgpack.packb({"who": ["Ann", None, 1.5, b"\0"], 7: True})], [REMOVE, 2],
                           [NOTE, msgpack.packb("left")]]  # fmt: skip
    assert second.calls == []
    with pytest.raises(TypeError):
        world.note(object())
    World.step(world)  # no note that a replay would reject was recorded


def test_two_pens_write_the_same_and_each_ends_on_its_own() -> None:
    file = io.BytesIO()
    world = recorded(file)
    world.step({1: worlds.EAST})
    copy = World(world.scene)
    copy.restore(world)

    class Second(Observer):
        def __init__(self) -> None:
            super().__init__(first=False)
            self.records: list[list[Any]] = []

        def tick(self, world: WorldState, inputs: Mapping[int, Input]) -> None:
            self.records.append(self.taken(world, inputs))

    pen = Second()
    world.attach(pen)
    hashes = play(world)
    world.detach(pen)
    world.step()
    for record, found in zip(pen.records, hashes, strict=True):
        redo(copy, record)  # a replay compares the marks from the first tick on
        assert copy.state_hash() == found
    assert [moment.world.state_hash() for moment in Recording(io.BytesIO(file.getvalue()))][1:-1] == hashes


def test_a_refused_edit_is_recorded_only_where_it_may_have_woken_someone() -> None:
    file = io.BytesIO()
    world = recorded(file)
    with pytest.raises(ValueError, match="kind"):
        world.set_block(0, 0, 0, 256)
    with pytest.raises(KeyError):
        world.remove(99)
    with pytest.raises(OverlapError):
        world.set_block(0, 0, 0, 1)
    world.remove(2)
    world.step()
    (moment,), _ = read(file.getvalue())
    assert [call[0] for call in moment.calls] == [FILL, REMOVE]


def test_a_world_that_is_not_recorded_or_no_longer_leaves_nothing_behind() -> None:
    file = io.BytesIO()
    world = recorded(file)
    with pytest.raises(JournalError, match="already"):
        world.record(file)
    with pytest.raises(JournalError, match="become another"):
        world.restore(worlds.build(FLOOR))
    world.end_recording()
    size = len(file.getvalue())
    play(world)
    world.end_recording()
    world.restore(worlds.build(FLOOR))
    assert len(file.getvalue()) == size


class Full:
    """A disk with room for `room` bytes."""

    def __init__(self, room: int) -> None:
        self.room = room

    def write(self, data: bytes) -> None:
        self.room -= len(data)
        if self.room < 0:
            raise OSError(28, "No space left on device")

    def flush(self) -> None: ...


def test_a_full_disk_ends_the_recording_and_not_the_world() -> None:
    world = RecordedWorld(worlds.scene(FLOOR))
    world.load_terrain()
    errors: list[OSError] = []
    world.record(Full(2000), errors.append)
    for _ in range(200):
        world.step()
    assert [error.errno for error in errors] == [28]
    assert world.tick == 200
    world.end_recording()
    with pytest.raises(OSError, match="No space"):
        world.record(Full(10))


def test_a_file_that_breaks_off_is_read_up_to_the_last_whole_record_whatever_the_byte() -> None:
    file = io.BytesIO()
    world = recorded(file)
    ends = []
    for tick in range(4):
        world.step({1: Input(tick, 0)})
        ends.append(len(file.getvalue()))
    world.end_recording()
    ends.append(len(file.getvalue()))
    data = file.getvalue()
    for size in range(ends[0], len(data) + 1):
        moments, recording = read(data[:size])
        whole = sum(end <= size for end in ends)
        assert len(moments) == whole
        assert recording.torn == size - ends[whole - 1]


@pytest.mark.parametrize("size", [0, 1, 7, 8, 9, 10, 15, 22, 100])
def test_a_file_without_a_start_says_so(size: int) -> None:
    file = io.BytesIO()
    recorded(file)
    with pytest.raises(JournalError, match="not a recording" if size == 0 else "before its start"):
        read(file.getvalue()[:size])


def test_another_file_and_a_newer_one_are_named() -> None:
    file = io.BytesIO()
    recorded(file)
    data = file.getvalue()
    with pytest.raises(JournalError, match="not a recording"):
        read(b"SQLite format 3\0")
    with pytest.raises(JournalError, match=r"format 4: this program reads formats up to 3"):
        read(MAGIC + struct.pack("<H", 4) + data[10:])


def test_a_recording_of_the_former_format_is_replayed_to_its_own_hashes() -> None:
    data = (FORMER / "recording.snj").read_bytes()
    moments, recording = read(data)
    assert data[8:10] == b"\2\0"
    assert sum(moment.hashed for moment in moments) == 3
    assert former.state_hash(recording.world).hex() == "1af78ad868c6022ecba396acb5ad1d7b"
    read(MAGIC + struct.pack("<H", 1) + data[10:])


FILE = io.BytesIO()
WORLD = recorded(FILE)
play(WORLD)
WORLD.end_recording()
DATA = FILE.getvalue()


@settings(max_examples=examples(300))
@given(at=st.integers(0, len(DATA) * 8 - 1))
def test_a_flipped_bit_is_found_wherever_it_is(at: int) -> None:
    data = bytearray(DATA)
    data[at // 8] ^= 1 << at % 8
    with pytest.raises(JournalError):
        read(bytes(data))


@pytest.mark.parametrize(
    ("record", "why"),
    [
        ([[], [[PUT, 1, 0, 0, 1 << 63, *[0] * 8]], None], "too large"),
        ([[1, 0, 0, 1 << 63], [[PUT, 1, *[0] * 11]], None], "must be a whole number from 0 to 255"),
        ([[], [[PUT, 0, *[0] * 11]], None], "a state is out of range"),
        ([[], [[PUT, 1, 99, *[0] * 10]], None], "a state is out of range"),
        ([[], [[PUT, 1, 0, 0, 1 << 60, *[0] * 8]], None], "a state is out of range"),
        ([[], [[PUT, 1, *[0] * 7, 1 << 40, 0, 0, 0]], None], "a state is out of range"),
        ([[], [[PUT, 1, *[0] * 8, 5000, 0, 0]], None], "a state is out of range"),
    ],
)
def test_a_number_that_no_world_can_hold_is_no_recording(record: list[Any], why: str) -> None:
    start = DATA[: 22 + struct.unpack_from("<I", DATA, 10)[0]]
    payload, chain = msgpack.packb(record), zlib.crc32(start[22:], zlib.crc32(start[:10]))
    length = struct.pack("<I", len(payload))
    checks = struct.pack("<II", zlib.crc32(length, chain), zlib.crc32(payload, chain))
    with pytest.raises(JournalError, match=rf"a recorded input or call cannot be repeated .*{why}"):
        read(start + length + checks + payload)


@settings(max_examples=examples(50))
@given(st.data())
def test_a_record_left_out_doubled_or_exchanged_is_found(draw: st.DataObject) -> None:
    records, at = [], len(MAGIC) + 2
    while at < len(DATA):
        size = 12 + struct.unpack_from("<I", DATA, at)[0]
        records.append(DATA[at : at + size])
        at += size
    i, j = sorted(draw.draw(st.lists(st.integers(1, len(records) - 2), min_size=2, max_size=2, unique=True)))
    broken = draw.draw(
        st.sampled_from(
            [
                records[:i] + records[i + 1 :],
                [*records[:i], records[i], *records[i:]],
                [*records[:i], records[j], *records[i + 1 : j], records[i], *records[j + 1 :]],
                [*records, records[i]],
            ]
        )
    )
    with pytest.raises(JournalError, match="damaged"):
        read(DATA[:10] + b"".join(broken))


def test_a_replay_that_comes_out_otherwise_names_the_tick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run"
    path.write_bytes(DATA)
    assert [moment.world.tick for moment in replay(path)][-2:] == [1001, 1001]
    step = World.step

    def slip(world: World, inputs: dict[int, Input]) -> None:
        step(world, {2: worlds.WEST} if world.tick == 11 else inputs)

    monkeypatch.setattr(World, "step", slip)
    with pytest.raises(DivergedError, match="entities that changed") as error:
        list(replay(path))
    assert error.value.tick == 12


def test_the_server_records_into_a_new_file_only(tmp_path: Path) -> None:
    scene, path = worlds.scene(FLOOR), tmp_path / "run"
    with keeping.recorded(scene, str(path)) as world:
        world.spawn("box", (0, 0, 3))
        worlds.steps(world, 40)
    moments = list(replay(path))
    assert moments[-1].ended
    assert moments[-1].world.state_hash() == world.state_hash()
    before = path.read_bytes()
    with pytest.raises(SettingsError, match="never overwritten"), keeping.recorded(scene, str(path)):
        raise AssertionError
    assert path.read_bytes() == before
    with pytest.raises(SettingsError, match="cannot be written"), keeping.recorded(scene, str(tmp_path / "no" / "run")):
        raise AssertionError
