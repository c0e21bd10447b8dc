"""A whole match is recorded and replayed to the same hashes: joins, leaves, falls into the void and edits included."""

import io
import random
from pathlib import Path as File

import pytest

from client_sdk.core import Core
from server.config.limits import Limits
from server.game import Game
from server.journal.recorded_world import RecordedWorld
from server.journal.records import FILL, JournalError, Recording
from shared.inputs import Input
from shared.scene import load_scene
from shared.world import World
from sovereign_netcode import replay
from sovereign_netcode.playtest import Link, Match, wander
from tests.lengths import long


def to_the_pit(core: Core, rng: random.Random) -> Input:
    """Walks to the pit that opens into the void, and into it, again and again."""
    assert core.prediction is not None
    predicted = core.prediction.predicted
    if core.entity not in predicted:
        return Input()
    x, y, _ = predicted.position(core.entity)
    way = (55.5 - x, 55.5 - y)
    length = max(abs(way[0]), abs(way[1]), 0.1)
    return Input(int(90 * way[0] / length), int(90 * way[1] / length), int(rng.random() < 0.1))


def build_and_dig(core: Core, rng: random.Random) -> Input:
    """Wanders, and sometimes places or removes a block beside itself."""
    assert core.prediction is not None
    if core.entity in core.prediction.predicted and rng.random() < 0.1:
        x, y, z = (int(part) for part in core.prediction.predicted.position(core.entity))
        core.edit(x + rng.randint(-2, 2), y + rng.randint(-2, 2), z + rng.randint(-1, 2), rng.choice((0, 0, 3)))
    return wander(core, rng)


class Played:
    """A recorded match of ten players and two more, who join and leave."""

    def __init__(self, seconds: float) -> None:
        scene = load_scene("arena")
        world = RecordedWorld(scene)
        world.load_terrain()
        self.file = io.BytesIO()
        world.record(self.file)
        match = Match(scene, 11)
        match.game = Game(scene, world=world, limits=Limits(resume_s=0.375 * seconds))  # all have left by the end
        self.hashes: dict[int, bytes] = {}
        self.ends: list[int] = []
        match.on_tick.append(lambda: self.hashes.update({world.tick: world.state_hash()}))
        match.on_tick.append(lambda: self.ends.append(len(self.file.getvalue())))
        path = Link(0.03, 0.02)
        players = [match.join(wander, path) for _ in range(8)]
        players += [match.join(to_the_pit, path), match.join(build_and_dig, path)]
        match.run(seconds / 4)
        players[0].disconnect()
        late = match.join(wander, path)
        match.run(seconds / 4)
        late.disconnect()
        players[1].disconnect()
        match.join(build_and_dig, path)
        match.run(seconds / 2)
        world.end_recording()
        self.data = self.file.getvalue()
        self.counters = match.game.counters
        self.seconds = seconds


SHORT_S = 16


@pytest.fixture(scope="module", params=[SHORT_S, *long(40)])
def played(request: pytest.FixtureRequest) -> Played:
    return Played(request.param)


@pytest.mark.parametrize("compiled", [None, False], ids=["compiled", "plain"])
def test_a_match_is_replayed_to_the_same_hash_at_every_tick(played: Played, compiled: bool | None) -> None:
    found = {}
    recording = Recording(io.BytesIO(played.data), compiled=compiled)
    hashed = fills = 0
    for moment in recording:
        found[moment.world.tick] = moment.world.state_hash()
        hashed += moment.hashed
        fills += sum(call[0] == FILL for call in moment.calls)
    assert found == played.hashes
    assert hashed == len(found) // 32 + 2
    assert fills > 20
    assert (played.counters.joined, played.counters.left) == (12, 3)
    assert played.counters.fell_out >= played.seconds // SHORT_S


def test_the_last_records_broken_off_at_every_byte_leave_the_ticks_before(played: Played) -> None:
    data, ends = played.data, played.ends
    for size in range(ends[2], ends[4] + 1):  # every byte of early records, where reading is quick
        recording = Recording(io.BytesIO(data[:size]))
        ticks = [moment.world.state_hash() for moment in recording]
        whole = sum(end <= size for end in ends)
        assert ticks == [played.hashes[tick] for tick in range(1, whole + 1)]
        assert recording.torn == size - ends[whole - 1]
    for size in range(ends[-2], len(data), 10 if played.seconds == SHORT_S else 1):
        recording = Recording(io.BytesIO(data[:size]))
        assert sum(not moment.ended for moment in recording) == len(ends) - (size < ends[-1])


def test_a_flipped_bit_anywhere_is_found(played: Played) -> None:
    rng = random.Random(1)
    for _ in range(30):
        data = bytearray(played.data)
        at = rng.randrange(8 * len(data))
        data[at // 8] ^= 1 << at % 8
        with pytest.raises(JournalError):
            for _ in Recording(io.BytesIO(data)):
                pass


# -- the script ----------------------------------------------------------------------------------------------


def test_the_script_says_that_all_is_as_recorded(
    played: Played, tmp_path: File, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "match"
    path.write_bytes(played.data)
    assert replay.main([str(path)]) == 0
    said = capsys.readouterr().out
    last = max(played.hashes)
    assert f"{last:,} ticks as recorded, to tick {last}" in said
    assert played.hashes[last].hex() in said
    path.write_bytes(played.data[: played.ends[-1] - 1])
    assert replay.main([str(path)]) == 0
    assert f"breaks off after tick {last - 1}" in capsys.readouterr().out


def test_the_script_shows_a_neighbourhood(played: Played, tmp_path: File, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "match"
    path.write_bytes(played.data)
    recording = Recording(io.BytesIO(played.data))
    met = next(
        (moment.world.tick, entity, moment.world.position(entity))
        for moment in recording
        if moment.world.tick > 100
        for entity in moment.world.entities["id"].tolist()
        if any("#" in text for text in replay.contacts(moment.world, entity))
    )
    assert replay.main([str(path), "--tick", str(met[0]), "--entity", str(met[1]), "--around", "2"]) == 0
    said = capsys.readouterr().out
    for text in (
        f"around entity {met[1]}",
        f"{met[2][0]:.6f}",
        "#",
        "below: block",
        *map(str, range(met[0] - 2, met[0] + 3)),
    ):
        assert text in said
    assert replay.main([str(path), "--tick", str(met[0]), "--around", "0"]) == 0
    assert "around entity" in capsys.readouterr().out
    assert replay.main([str(path), "--tick", "999999"]) == 2
    assert "tick 999999 is not in this recording" in capsys.readouterr().err


def test_the_script_names_the_tick_that_differs(
    played: Played,
    tmp_path: File,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "match"
    path.write_bytes(played.data)
    step = World.step

    def slip(world: World, inputs: dict[int, Input]) -> None:
        step(world, inputs)
        if world.tick == 333:
            state = list(world.state(2))
            state[3] += 1
            world.put([tuple(state)])

    monkeypatch.setattr(World, "step", slip)
    assert replay.main([str(path)]) == 1
    assert "differs at tick 33" in capsys.readouterr().out


def test_the_script_refuses_a_file_that_is_no_recording(tmp_path: File, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text").write_text("hello", "utf-8")
    assert replay.main([str(tmp_path / "text")]) == 2
    assert replay.main([str(tmp_path / "nowhere")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert "not a recording" in said[0]
    assert "No such file" in said[1]
