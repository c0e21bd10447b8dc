"""What changed since any tick, and that a client which is told so has exactly what the server has."""

import random

import msgpack
import numpy as np
import pytest

from server.config.limits import Limits
from server.game import Game
from server.game.session import Session
from server.replication.change_log import PACKS_PER_TICK, ChangeLog
from shared.blocks import Kinds, unpack
from shared.bounds import bounds
from shared.checks import Cell
from shared.inputs import Input
from shared.layout import FALLING, FLAGS, ID
from shared.messages import VERSION, Hello, Resync, Snapshot, Terrain, Welcome, decode_from_server, encode
from shared.scene import Scene
from shared.snapshot import ACTED, KEYFRAME, PLACED, decode_parts
from shared.units import BLOCK, SEGMENT
from shared.world import OverlapError, World
from tests.worlds import scene

HOME, EAST, WEST = (0, 0, 0), (1, 0, 0), (-1, 0, 0)

HISTORY = bounds(64).history


def row_of_segments() -> Scene:
    """Seven segments in a row along x, their floor with holes into the void at either end."""
    return scene(
        [[-60, 0, 0, 90, 32, 1, 1], [40, 8, 1, 42, 9, 3, 2]],
        origin=(-3, 0, 0),
        size=(7, 1, 1),
        spawns=((16.0, 16.0, 1.0),),
    )


class Recorded:
    """A world with its log, ticking."""

    def __init__(self, compiled: bool) -> None:
        self.world = World(row_of_segments(), compiled=compiled)
        self.world.load_terrain()
        self.log = ChangeLog(self.world)

    def tick(self, n: int = 1) -> None:
        for _ in range(n):
            self.world.step()
            self.log.record()

    def remove(self, entity: int) -> None:
        self.world.remove(entity)
        self.log.note_removal(entity)

    def edit(self, x: int, y: int, z: int, kind: int) -> None:
        self.world.set_block(x, y, z, kind)

    def changed(self, since: int) -> set[Cell]:
        """The segments of which there is something to tell."""
        return {segment for segment in self.world.scene.segments() if self.log.since(since)[segment]}

    def part(self, segment: Cell, since: int) -> tuple[list[int], list[int], list[tuple[int, int]]]:
        """Ids of the rows, ids of the gone, edits."""
        encoded = self.log.since(since)[segment]
        if not encoded:
            return [], [], []
        (part,), states, turns = decode_parts([msgpack.unpackb(encoded)], 255)
        assert (part.segment, part.ago) == (segment, since if since == KEYFRAME else self.world.tick - since)
        for state in states.tolist():
            state[FLAGS] &= FALLING
            assert tuple(state) == self.world.state(state[ID])
        return states[:, ID].tolist() + turns[:, 0].tolist(), part.gone, part.edits.tolist()


@pytest.fixture
def told(compiled: bool) -> Recorded:
    return Recorded(compiled)


def test_what_nothing_happened_to_is_not_mentioned(told: Recorded) -> None:
    told.world.spawn("box", (5, 5, 1))
    told.tick(3)
    assert told.changed(2) == set()
    assert told.part(HOME, 2) == ([], [], [])
    assert told.part(HOME, 0) == ([1], [], [])


def test_a_keyframe_is_all_that_is_there_however_long_ago_it_moved(told: Recorded) -> None:
    for x in (5, 9, 40, -5):
        told.world.spawn("box", (x, 5, 1))
    told.tick(HISTORY + 5)
    assert told.part(HOME, KEYFRAME) == ([1, 2], [], [])
    assert told.part(EAST, KEYFRAME) == ([3], [], [])
    assert told.part((2, 0, 0), KEYFRAME) == ([], [], [])


def test_who_crosses_a_border_is_gone_here_and_there_whole(told: Recorded) -> None:
    told.world.spawn("box", (31, 5, 1))
    told.tick()
    told.world.place(1, (33, 5, 1))
    told.tick()
    assert told.changed(1) == {HOME, EAST}
    assert told.part(HOME, 1) == ([], [1], [])
    assert told.part(EAST, 1) == ([1], [], [])
    assert told.log.segment(1) == EAST


def test_who_came_back_is_not_gone(told: Recorded) -> None:
    told.world.spawn("box", (31, 5, 1))
    told.tick()
    for x in (33, 31):
        told.world.place(1, (x, 5, 1))
        told.tick()
    assert told.part(HOME, 1) == ([1], [], [])
    assert told.part(EAST, 1) == ([], [1], [])
    assert told.part(EAST, 2) == ([], [1], [])


def test_the_removed_are_gone_and_an_entity_never_recorded_is_not_mentioned(told: Recorded) -> None:
    told.world.spawn("box", (5, 5, 1))
    told.tick()
    told.remove(1)
    told.remove(told.world.spawn("box", (9, 5, 1)))
    told.tick()
    assert told.part(HOME, 1) == ([], [1], [])
    assert told.part(HOME, 0) == ([], [1], [])
    assert told.part(HOME, KEYFRAME) == ([], [], [])


def test_ids_are_not_used_again_but_rows_are(told: Recorded) -> None:
    told.world.spawn("box", (5, 5, 1))
    told.tick(3)
    told.remove(1)
    assert told.world.spawn("box", (5, 5, 1)) == 2
    told.tick()
    assert told.part(HOME, 3) == ([2], [1], [])


def test_an_edit_is_told_as_the_block_is_now(told: Recorded) -> None:
    at = 3 << 10 | 2 << 5 | 1
    for kind in (7, 0, 9):
        told.edit(1, 2, 3, kind)
        told.tick()
    assert [told.part(HOME, since)[2] for since in (0, 1, 2, 3)] == [[(at, 9)]] * 3 + [[]]


def test_an_edit_back_is_told_too(told: Recorded) -> None:
    told.edit(-1, 31, 31, 5)
    told.tick()
    told.edit(-1, 31, 31, 0)
    told.tick()
    assert told.part(WEST, 1)[2] == [(31 << 10 | 31 << 5 | 31, 0)]
    assert told.changed(1) == {WEST}


def test_every_change_of_a_block_in_the_world_is_told(told: Recorded) -> None:
    told.world.fill((1, 2, 3), (3, 3, 4), 7)
    told.world.write_blocks(WEST, [5], [9])
    told.tick()
    at = 3 << 10 | 2 << 5 | 1
    assert told.part(HOME, 0)[2] == [(at, 7), (at + 1, 7)]
    assert told.part(WEST, 0)[2] == [(5, 9)]


def test_an_edit_that_changes_nothing_is_not_told(told: Recorded) -> None:
    told.edit(1, 2, 3, 7)
    told.tick()
    told.edit(1, 2, 3, 7)
    told.tick()
    assert told.changed(1) == set()


def test_who_was_acted_upon_is_flagged_in_every_part_that_tells_of_it(told: Recorded) -> None:
    for x in (5, 9):
        told.world.spawn("box", (x, 5, 1))
    told.tick()
    told.world.place(1, (7, 5, 3))
    told.log.note_act(1)
    told.tick(2)
    assert told.log.since(2)[HOME] == b"", "it falls, as was to be expected"
    for since in (1, 0):
        _, states, _ = decode_parts([msgpack.unpackb(told.log.since(since)[HOME])], 255)
        assert states[states[:, FLAGS] & ACTED != 0, ID].tolist() == [1]


def flags(told: Recorded, segment: Cell, since: int) -> dict[int, int]:
    """The flags of the rules in a part, by entity."""
    _, states, _ = decode_parts([msgpack.unpackb(told.log.since(since)[segment])], 255)
    return dict(zip(states[:, ID].tolist(), (states[:, FLAGS] & ~FALLING).tolist(), strict=True))


def test_who_was_placed_is_flagged_as_such_and_who_was_thrown_or_changed_is_not(told: Recorded) -> None:
    for x in (5, 9, 13, 17):
        told.world.spawn("box", (x, 5, 1))
    told.tick()
    told.world.place(1, (7, 5, 1))
    for entity in (2, 3):
        told.log.note_act(entity)
    told.world.set_velocity(2, (0, 0, 5))
    told.world.set_template(3, "ghost")
    told.world.spawn("box", (21, 5, 1))
    told.tick()
    acts = {1: ACTED | PLACED, 2: ACTED, 3: ACTED}
    assert flags(told, HOME, 1) == {**acts, 5: 0}
    told.tick()
    assert flags(told, HOME, 1) == {**acts, 5: 0}
    assert flags(told, HOME, 0) == {**acts, 4: 0, 5: 0}


def test_who_was_placed_out_of_a_segment_is_flagged_in_the_other_and_in_its_keyframe_for_a_while(
    told: Recorded,
) -> None:
    for x in (5, 40):
        told.world.spawn("stone", (x, 5, 1))
    told.tick(2)
    assert flags(told, EAST, KEYFRAME) == {2: 0}
    told.world.place(1, (45, 5, 1))
    told.tick()
    for _ in range(HISTORY):
        assert flags(told, EAST, 2 if told.world.tick - 2 <= HISTORY else 3).get(1, 0) in (0, ACTED | PLACED)
        assert flags(told, EAST, KEYFRAME) == {1: ACTED | PLACED, 2: 0}
        told.tick()
    assert flags(told, EAST, KEYFRAME) == {1: 0, 2: 0}


def test_whoever_places_an_entity_it_is_told() -> None:
    game = Game(row_of_segments(), compiled=False)
    world, stage = game.world, game.api
    thing, pushed = stage.spawn("box", (5, 5, 1)), stage.spawn("box", (9, 5, 1))
    game.tick(0.0, 0.0)
    stage.place(thing, (7, 5, 1))
    world.fill((9, 5, 1), (10, 6, 2), 3, push=True)
    assert world.placing == {thing, pushed}
    game.tick(0.0, 0.0)
    assert (world.placing, world.placed) == (set(), {thing, pushed})
    with pytest.raises(OverlapError):
        world.place(thing, (9, 5, 1))
    game.tick(0.0, 0.0)
    assert world.placed == set()


def test_history_reaches_back_as_far_as_it_says_and_not_further(told: Recorded) -> None:
    told.world.spawn("box", (5, 5, 1))
    told.tick(1)
    told.world.place(1, (6, 5, 1))
    told.tick(HISTORY)
    assert told.changed(1) == {HOME}
    assert told.part(HOME, 1)[0] == [1]
    told.tick()
    assert told.changed(2) == set()
    with pytest.raises(AssertionError, match="lost track"):
        told.log.encode(HOME, 1)


def test_the_void_below_the_floor_has_parts_like_any_segment(told: Recorded) -> None:
    told.world.spawn("box", (-80, 5, 0))
    told.world.spawn("box", (5, 5, 1))
    told.tick(20)
    below = told.log.segment(1)
    assert below == (-3, 0, -1)
    assert told.part(below, KEYFRAME) == ([1], [], [])
    assert told.part(below, 19) == ([], [], []), "it falls on"
    assert told.part(below, 0) == ([1], [], [])
    told.remove(1)
    told.tick()
    assert told.part(below, 20) == ([], [1], [])


def test_one_encoding_serves_all_who_ask_for_the_same(told: Recorded) -> None:
    told.world.spawn("box", (5, 5, 9))
    told.tick(2)
    assert told.log.since(1)[HOME] is told.log.since(1)[HOME]
    assert told.log.packed(HOME) is told.log.packed(HOME)
    before = told.log.packed(HOME)
    told.edit(1, 1, 1, 1)
    after = told.log.packed(HOME)
    assert before != after is not None
    assert unpack(after).reshape(SEGMENT, SEGMENT, SEGMENT)[1, 1, 1] == 1


def test_what_is_seen_around_a_segment_is_joined_once_for_all_who_see_the_same(told: Recorded) -> None:
    told.tick()
    for x in (3, 35):
        told.edit(x, 3, 9, 1)
    told.tick()
    known = told.log.since(1)
    all_three, both = (HOME, EAST, WEST), (HOME, WEST)
    assert known.together(all_three) == (2, known[HOME] + known[EAST])
    assert known.together(all_three)[1] is known.together(all_three)[1]
    assert known.together(both) == (1, known[HOME]), "what one does not see is not what another sees"
    assert known.together(all_three) == (2, known[HOME] + known[EAST])


def test_a_tick_packs_few_segments_and_the_next_one_packs_on(told: Recorded) -> None:
    for i in range(PACKS_PER_TICK):
        told.edit(1, 1, 1, i + 1)
        assert told.log.packed(HOME) is not None
    assert told.log.packed(EAST) is None
    assert told.log.packed(HOME) is not None, "it is packed already"
    told.tick()
    assert told.log.packed(EAST) is not None


def test_memory_is_bounded_by_history_and_by_what_exists(told: Recorded) -> None:
    for i in range(HISTORY + 50):
        told.world.spawn("box", (5, 5, 20))
        told.tick()
        told.log.since(max(0, i - 3))[HOME]
        told.remove(i + 1)
    told.tick(HISTORY + 1)
    assert told.log._home == {}
    assert len(told.log._parts) == 0
    assert not any(slot[1].changed or slot[1].gone for slot in told.log._ticks._slots if slot)


# -- a client that is told, with any skips and any interest --------------------------------------------------


class Model:
    """All that a client must do with what it is told, as plainly as possible. It is the link as well."""

    def __init__(self, scene: Scene) -> None:
        self.world = World(scene, compiled=False)
        self.blocks: dict[Cell, Kinds] = {}
        self.coming: dict[Cell, bytearray] = {}
        self.edits: dict[Cell, list[np.ndarray]] = {}
        self.tick = -1
        self.stuck = False
        self.told = 0

    def outstanding(self) -> int:
        return 1 << 30 if self.stuck else 0

    def close(self, code: int, reason: str) -> None:
        raise AssertionError(reason)

    def send(self, message: bytes) -> None:
        match decode_from_server(message):
            case Snapshot() as snapshot:
                self.snapshot(snapshot)
            case Terrain(x, y, z, offset, total, chunk):
                self.terrain((x, y, z), offset, total, chunk)
            case other:
                assert isinstance(other, Welcome)

    def snapshot(self, snapshot: Snapshot) -> None:
        assert snapshot.tick > self.tick
        parts, states, turns = decode_parts(snapshot.segments, len(self.world.scene.templates))
        states[:, FLAGS] &= FALLING
        new = set(states[:, ID].tolist())
        homes = {state[ID]: home_of(state) for state in self.world.states().tolist()}
        assert snapshot.tick == self.tick + 1 or not len(turns)
        self.told += len(turns)
        dropped = {tuple(segment) for segment in np.frombuffer(snapshot.drops, "<i4").reshape(-1, 3).tolist()}
        for segment in dropped:
            self.blocks.pop(segment, None)
            self.edits.pop(segment, None)
        anew = dropped | {part.segment for part in parts if part.ago == KEYFRAME}
        gone = {(part.segment, entity) for part in parts for entity in part.gone}
        for entity, home in homes.items():
            if entity not in new and (home in anew or (home, entity) in gone):
                self.world.remove(entity)
        self.world.put(states)
        assert self.world.follow(turns, snapshot.tick - self.tick, snapshot.tick)
        for part in parts:
            assert part.ago == KEYFRAME or 0 < part.ago <= HISTORY
            self.edits.setdefault(part.segment, []).append(part.edits)
            if part.segment in self.blocks:
                self.write(part.segment, part.edits)
        self.tick = snapshot.tick

    def terrain(self, segment: Cell, offset: int, total: int, chunk: bytes) -> None:
        if offset == 0:
            self.coming[segment] = bytearray()
            self.edits[segment] = []  # what was told before is in what was packed now
        assert len(self.coming[segment]) == offset
        self.coming[segment] += chunk
        if len(self.coming[segment]) == total:
            self.blocks[segment] = unpack(bytes(self.coming.pop(segment))).copy()
            for edits in self.edits.pop(segment, []):
                self.write(segment, edits)

    def write(self, segment: Cell, edits: np.ndarray) -> None:
        self.blocks[segment][edits["block"]] = edits["kind"]


def home_of(state: list[int]) -> Cell:
    x, y, z = (part // (BLOCK * SEGMENT) for part in state[3:6])
    return x, y, z


class Told:
    """A game in which everything changes at random, and one client with a link that stalls at random."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        limits = Limits(terrain_chunk_bytes=16, terrain_bytes_per_tick=64, stalled_s=1e9, silence_s=1e9)
        self.game = Game(row_of_segments(), limits=limits, compiled=False)
        self.model = Model(self.game.scene)
        self.now = 0.0
        self.session: Session = self.game.open(self.model, 0.0)
        self.game.receive(self.session, encode(Hello(VERSION, {}, "")), 0.0)
        self.others: list[int] = []
        self.stuck_until = 0

    def tick(self) -> None:
        self.now += 1 / self.game.scene.tick_rate
        for entity in self.others:
            if self.rng.random() < 0.2:
                input_ = Input(self.rng.randint(-89, 89), self.rng.randint(-89, 89), self.rng.randint(0, 1))
                self.game.api.steered[entity] = input_
        self.game.tick(self.now, self.now)

    def place(self) -> tuple[float, float, float]:
        return self.rng.uniform(-95, 127), self.rng.uniform(1, 31), self.rng.choice([1.0, 1.0, 5.0, 30.9, -3.0])

    def stir(self) -> None:
        world, log, rng = self.game.world, self.game.log, self.rng
        try:
            match rng.randrange(12):
                case 0:
                    self.others.append(world.spawn(rng.choice(["box", "cube", "ghost"]), self.place()))
                case 1 if self.others:
                    entity = self.others.pop(rng.randrange(len(self.others)))
                    world.remove(entity)
                    log.note_removal(entity)
                case 2 if self.others:
                    world.place(rng.choice(self.others), self.place())
                case 3 if self.others:
                    world.set_velocity(rng.choice(self.others), (rng.uniform(-9, 9), 0, rng.uniform(0, 9)))
                case 4:
                    world.place(self.session.entity, self.place())
                case 5 | 6 | 7:
                    at = (rng.choice([-33, -32, -1, 0, 31, 32, 64]), rng.choice([3, 4]), rng.choice([2, 3]))
                    world.set_block(*at, rng.choice([0, 0, 1, 200]))
                case 8 if rng.random() < 0.3:
                    self.game.receive(self.session, encode(Resync()), self.now)
        except OverlapError:
            pass

    def stall(self) -> None:
        tick = self.game.world.tick
        if tick >= self.stuck_until and self.rng.random() < 0.06:
            self.stuck_until = tick + self.rng.choice([1, 2, 5, 20, 63, 64, 65, 66])
        self.model.stuck = tick < self.stuck_until

    def check(self) -> None:
        """The client has just what the server has in the segments it sees."""
        game, model, session = self.game, self.model, self.session
        assert model.tick == game.world.tick
        sees = session.stream.view.sees
        here = [entity for entity in game.world.entities["id"].tolist() if game.log.segment(entity) in sees]
        assert model.world.states().tolist() == [list(game.world.state(entity)) for entity in here]
        assert session.entity in model.world
        under_way = {*session.stream.terrain_due, session.stream.terrain_now[0] if session.stream.terrain_now else None}
        assert set(model.blocks) - session.stream.view.sees == set()
        for segment in session.stream.view.sees - under_way:
            if segment in game.world.blocks:
                assert (model.blocks[segment] == game.world.blocks.segment(segment).reshape(-1)).all()


@pytest.mark.parametrize("seed", range(6))
def test_a_client_has_what_the_server_has_whatever_it_skipped_and_wherever_it_looked(seed: int) -> None:
    told, checks = Told(seed), 0
    told.tick()
    for _ in range(400):
        told.stir()
        told.stir()
        told.stall()
        told.tick()
        if not told.model.stuck and told.session.stream.view.complete:
            told.check()
            checks += 1
    told.model.stuck = False
    for _ in range(60):
        told.tick()
    told.check()
    assert told.session.stream.view.complete
    assert checks > 50
    assert told.model.told > 10
    assert not told.session.stream.terrain_due
    assert told.game.counters.snapshots_skipped > 50
