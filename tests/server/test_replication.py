"""Changes since any tick: a client that applies them has exactly the server's state."""

import contextlib
import random
from typing import Any

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
from shared.messages import VERSION, Announce, Hello, Resync, Snapshot, Terrain, Welcome, decode_from_server, encode
from shared.scene import Scene
from shared.snapshot import ACTED, KEYFRAME, PLACED, decode_parts, encode_part
from shared.units import BLOCK, SEGMENT
from shared.world import OverlapError, World
from tests.lengths import long_but
from tests.worlds import build, floor, scene

HOME, EAST, WEST = (0, 0, 0), (1, 0, 0), (-1, 0, 0)

HISTORY = bounds(64).history


def row_of_segments() -> Scene:
    """Returns a scene of seven segments in a row along x. Its floor has a hole into the void at each end."""
    return scene(
        [[-60, 0, 0, 90, 32, 1, 1], [40, 8, 1, 42, 9, 3, 2]],
        origin=(-3, 0, 0),
        size=(7, 1, 1),
        spawns=((16.0, 16.0, 1.0),),
    )


class Recorded:
    """A world with its change log, which ticks."""

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
        """Returns the segments that have changed."""
        return {segment for segment in self.world.scene.segments() if self.log.since(since)[segment]}

    def part(self, segment: Cell, since: int) -> tuple[list[int], list[int], list[tuple[int, int]]]:
        """Returns the ids of the rows, the ids of the gone, and the edits."""
        encoded = self.log.since(since)[segment]
        if not encoded:
            return [], [], []
        (part,), states, turns = decode_parts([msgpack.unpackb(encoded)], 255)
        assert (part.segment, part.ago) == (segment, since if since == KEYFRAME else self.world.tick - since)
        for state in states.tolist():
            state[FLAGS] &= FALLING
            assert tuple(state) == self.world.state(state[ID])
        return states[:, ID].tolist() + turns[:, 0].tolist(), part.gone, part.edits


@pytest.fixture
def recorded(compiled: bool) -> Recorded:
    return Recorded(compiled)


def test_unchanged_entities_are_not_sent(recorded: Recorded) -> None:
    recorded.world.spawn("box", (5, 5, 1))
    recorded.tick(3)
    assert recorded.changed(2) == set()
    assert recorded.part(HOME, 2) == ([], [], [])
    assert recorded.part(HOME, 0) == ([1], [], [])


def test_a_keyframe_is_all_that_is_there_however_long_ago_it_moved(recorded: Recorded) -> None:
    for x in (5, 9, 40, -5):
        recorded.world.spawn("box", (x, 5, 1))
    recorded.tick(HISTORY + 5)
    assert recorded.part(HOME, KEYFRAME) == ([1, 2], [], [])
    assert recorded.part(EAST, KEYFRAME) == ([3], [], [])
    assert recorded.part((2, 0, 0), KEYFRAME) == ([], [], [])


def test_an_entity_that_crosses_a_border_is_gone_here_and_whole_there(recorded: Recorded) -> None:
    recorded.world.spawn("box", (31, 5, 1))
    recorded.tick()
    recorded.world.place(1, (33, 5, 1))
    recorded.tick()
    assert recorded.changed(1) == {HOME, EAST}
    assert recorded.part(HOME, 1) == ([], [1], [])
    assert recorded.part(EAST, 1) == ([1], [], [])
    assert recorded.log.segment(1) == EAST


def test_an_entity_that_came_back_is_not_gone(recorded: Recorded) -> None:
    recorded.world.spawn("box", (31, 5, 1))
    recorded.tick()
    for x in (33, 31):
        recorded.world.place(1, (x, 5, 1))
        recorded.tick()
    assert recorded.part(HOME, 1) == ([1], [], [])
    assert recorded.part(EAST, 1) == ([], [1], [])
    assert recorded.part(EAST, 2) == ([], [1], [])


def test_the_removed_are_gone_and_an_entity_never_recorded_is_not_mentioned(recorded: Recorded) -> None:
    recorded.world.spawn("box", (5, 5, 1))
    recorded.tick()
    recorded.remove(1)
    recorded.remove(recorded.world.spawn("box", (9, 5, 1)))
    recorded.tick()
    assert recorded.part(HOME, 1) == ([], [1], [])
    assert recorded.part(HOME, 0) == ([], [1], [])
    assert recorded.part(HOME, KEYFRAME) == ([], [], [])


def test_ids_are_not_used_again_but_rows_are(recorded: Recorded) -> None:
    recorded.world.spawn("box", (5, 5, 1))
    recorded.tick(3)
    recorded.remove(1)
    assert recorded.world.spawn("box", (5, 5, 1)) == 2
    recorded.tick()
    assert recorded.part(HOME, 3) == ([2], [1], [])


def test_an_edit_is_sent_as_the_present_block(recorded: Recorded) -> None:
    at = 3 << 10 | 2 << 5 | 1
    for kind in (7, 0, 9):
        recorded.edit(1, 2, 3, kind)
        recorded.tick()
    assert [recorded.part(HOME, since)[2] for since in (0, 1, 2, 3)] == [[(at, 9)]] * 3 + [[]]


def test_an_edit_back_is_sent_too(recorded: Recorded) -> None:
    recorded.edit(-1, 31, 31, 5)
    recorded.tick()
    recorded.edit(-1, 31, 31, 0)
    recorded.tick()
    assert recorded.part(WEST, 1)[2] == [(31 << 10 | 31 << 5 | 31, 0)]
    assert recorded.changed(1) == {WEST}


def test_every_change_of_a_block_in_the_world_is_sent(recorded: Recorded) -> None:
    recorded.world.fill((1, 2, 3), (3, 3, 4), 7)
    recorded.world.write_blocks(WEST, [5], [9])
    recorded.tick()
    at = 3 << 10 | 2 << 5 | 1
    assert recorded.part(HOME, 0)[2] == [(at, 7), (at + 1, 7)]
    assert recorded.part(WEST, 0)[2] == [(5, 9)]


def test_an_edit_that_changes_nothing_is_not_sent(recorded: Recorded) -> None:
    recorded.edit(1, 2, 3, 7)
    recorded.tick()
    recorded.edit(1, 2, 3, 7)
    recorded.tick()
    assert recorded.changed(1) == set()


def test_an_entity_that_the_rules_acted_on_is_flagged_in_every_part_with_it(recorded: Recorded) -> None:
    for x in (5, 9):
        recorded.world.spawn("box", (x, 5, 1))
    recorded.tick()
    recorded.world.place(1, (7, 5, 3))
    recorded.log.note_act(1)
    recorded.tick(2)
    assert recorded.log.since(2)[HOME] == b"", "it falls, as expected"
    for since in (1, 0):
        _, states, _ = decode_parts([msgpack.unpackb(recorded.log.since(since)[HOME])], 255)
        assert states[states[:, FLAGS] & ACTED != 0, ID].tolist() == [1]


def flags(recorded: Recorded, segment: Cell, since: int) -> dict[int, int]:
    """Returns the flags of the rules in a part, by entity."""
    _, states, _ = decode_parts([msgpack.unpackb(recorded.log.since(since)[segment])], 255)
    return dict(zip(states[:, ID].tolist(), (states[:, FLAGS] & ~FALLING).tolist(), strict=True))


def test_a_placed_entity_is_flagged_as_placed_and_a_thrown_or_changed_one_is_not(recorded: Recorded) -> None:
    for x in (5, 9, 13, 17):
        recorded.world.spawn("box", (x, 5, 1))
    recorded.tick()
    recorded.world.place(1, (7, 5, 1))
    for entity in (2, 3):
        recorded.log.note_act(entity)
    recorded.world.set_velocity(2, (0, 0, 5))
    recorded.world.set_template(3, "ghost")
    recorded.world.spawn("box", (21, 5, 1))
    recorded.tick()
    acts = {1: ACTED | PLACED, 2: ACTED, 3: ACTED}
    assert flags(recorded, HOME, 1) == {**acts, 5: 0}
    recorded.tick()
    assert flags(recorded, HOME, 1) == {**acts, 5: 0}
    assert flags(recorded, HOME, 0) == {**acts, 4: 0, 5: 0}


def test_an_entity_that_was_placed_out_of_a_segment_is_flagged_in_the_other_and_in_its_keyframe_for_a_while(
    recorded: Recorded,
) -> None:
    for x in (5, 40):
        recorded.world.spawn("stone", (x, 5, 1))
    recorded.tick(2)
    assert flags(recorded, EAST, KEYFRAME) == {2: 0}
    recorded.world.place(1, (45, 5, 1))
    recorded.tick()
    for _ in range(HISTORY):
        assert flags(recorded, EAST, 2 if recorded.world.tick - 2 <= HISTORY else 3).get(1, 0) in (0, ACTED | PLACED)
        assert flags(recorded, EAST, KEYFRAME) == {1: ACTED | PLACED, 2: 0}
        recorded.tick()
    assert flags(recorded, EAST, KEYFRAME) == {1: 0, 2: 0}


def test_each_placed_entity_is_noted_whatever_placed_it() -> None:
    game = Game(row_of_segments())
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


def test_history_reaches_back_as_far_as_it_says_and_not_further(recorded: Recorded) -> None:
    recorded.world.spawn("box", (5, 5, 1))
    recorded.tick(1)
    recorded.world.place(1, (6, 5, 1))
    recorded.tick(HISTORY)
    assert recorded.changed(1) == {HOME}
    assert recorded.part(HOME, 1)[0] == [1]
    recorded.tick()
    assert recorded.changed(2) == set()
    with pytest.raises(AssertionError, match="lost track"):
        recorded.log.encode(HOME, 1)


def test_the_void_below_the_floor_has_parts_like_any_segment(recorded: Recorded) -> None:
    recorded.world.spawn("box", (-80, 5, 0))
    recorded.world.spawn("box", (5, 5, 1))
    recorded.tick(20)
    below = recorded.log.segment(1)
    assert below == (-3, 0, -1)
    assert recorded.part(below, KEYFRAME) == ([1], [], [])
    assert recorded.part(below, 19) == ([], [], []), "it goes on falling"
    assert recorded.part(below, 0) == ([1], [], [])
    recorded.remove(1)
    recorded.tick()
    assert recorded.part(below, 20) == ([], [1], [])


def test_one_encoding_serves_all_clients_with_the_same_tick(recorded: Recorded) -> None:
    recorded.world.spawn("box", (5, 5, 9))
    recorded.tick(2)
    assert recorded.log.since(1)[HOME] is recorded.log.since(1)[HOME]
    assert recorded.log.packed(HOME) is recorded.log.packed(HOME)
    before = recorded.log.packed(HOME)
    recorded.edit(1, 1, 1, 1)
    after = recorded.log.packed(HOME)
    assert before != after is not None
    assert unpack(after).reshape(SEGMENT, SEGMENT, SEGMENT)[1, 1, 1] == 1


def test_the_parts_of_one_view_are_joined_once_for_all_its_clients(recorded: Recorded) -> None:
    recorded.tick()
    for x in (3, 35):
        recorded.edit(x, 3, 9, 1)
    recorded.tick()
    deltas = recorded.log.since(1)
    all_three, both = (HOME, EAST, WEST), (HOME, WEST)
    assert deltas.together(all_three) == (2, deltas[HOME] + deltas[EAST])
    assert deltas.together(all_three)[1] is deltas.together(all_three)[1]
    assert deltas.together(both) == (1, deltas[HOME]), "another view is joined separately"
    assert deltas.together(all_three) == (2, deltas[HOME] + deltas[EAST])


def test_a_tick_packs_few_segments_and_the_next_one_packs_on(recorded: Recorded) -> None:
    for i in range(PACKS_PER_TICK):
        recorded.edit(1, 1, 1, i + 1)
        assert recorded.log.packed(HOME) is not None
    assert recorded.log.packed(EAST) is None
    assert recorded.log.packed(HOME) is not None, "it is packed already"
    recorded.tick()
    assert recorded.log.packed(EAST) is not None


def test_memory_is_bounded_by_history_and_by_what_exists(recorded: Recorded) -> None:
    for i in range(HISTORY + 50):
        recorded.world.spawn("box", (5, 5, 20))
        recorded.tick()
        recorded.log.since(max(0, i - 3))[HOME]
        recorded.remove(i + 1)
    recorded.tick(HISTORY + 1)
    assert recorded.log._home == {}
    assert len(recorded.log._parts) == 0
    assert not any(slot[1].changed or slot[1].gone for slot in recorded.log._ticks._slots if slot)


# -- a client with any skips and any interest -----------------------------------------------------------------


class Model:
    """A client in the plainest form: it applies messages to a world. It is the server's link, too."""

    def __init__(self, scene: Scene) -> None:
        self.world = World(scene)
        self.blocks: dict[Cell, Kinds] = {}
        self.coming: dict[Cell, bytearray] = {}
        self.edits: dict[Cell, list[list[tuple[int, int]]]] = {}
        self.tick = -1
        self.stuck = False
        self.turns = 0

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
                assert isinstance(other, Welcome | Announce)

    def snapshot(self, snapshot: Snapshot) -> None:
        assert snapshot.tick > self.tick
        parts, states, turns = decode_parts(snapshot.segments, len(self.world.scene.templates))
        states[:, FLAGS] &= FALLING
        new = set(states[:, ID].tolist())
        homes = {state[ID]: home_of(state) for state in self.world.states().tolist()}
        assert snapshot.tick == self.tick + 1 or not len(turns)
        self.turns += len(turns)
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
        for part in parts:
            assert self.world.write_fields(self.world.extras.decode(part.fields))
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
            self.edits[segment] = []  # earlier edits are contained in the blocks packed now
        assert len(self.coming[segment]) == offset
        self.coming[segment] += chunk
        if len(self.coming[segment]) == total:
            self.blocks[segment] = unpack(bytes(self.coming.pop(segment))).copy()
            for edits in self.edits.pop(segment, []):
                self.write(segment, edits)

    def write(self, segment: Cell, edits: list[tuple[int, int]]) -> None:
        for block, kind in edits:
            self.blocks[segment][block] = kind


def home_of(state: list[int]) -> Cell:
    x, y, z = (part // (BLOCK * SEGMENT) for part in state[3:6])
    return x, y, z


class Stalling:
    """A game in which everything changes at random, and one client whose link stalls at random."""

    def __init__(self, seed: int, scene: Scene | None = None) -> None:
        self.rng = random.Random(seed)
        limits = Limits(terrain_chunk_bytes=16, terrain_bytes_per_tick=64, stalled_s=1e9, silence_s=1e9)
        self.game = Game(scene or row_of_segments(), limits=limits)
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
        """Checks that the client has exactly the server's state in the segments that it sees."""
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


@pytest.mark.parametrize("seed", long_but([0, 3], range(6)))
def test_a_client_equals_the_server_with_any_skips_and_any_interest(seed: int) -> None:
    recorded, checks = Stalling(seed), 0
    recorded.tick()
    for _ in range(400):
        recorded.stir()
        recorded.stir()
        recorded.stall()
        recorded.tick()
        if not recorded.model.stuck and recorded.session.stream.view.complete:
            recorded.check()
            checks += 1
    recorded.model.stuck = False
    for _ in range(60):
        recorded.tick()
    recorded.check()
    assert recorded.session.stream.view.complete
    assert checks > 50
    assert recorded.model.turns > 10
    assert not recorded.session.stream.terrain_due
    assert recorded.game.counters.snapshots_skipped > 50


def test_a_keyframe_has_the_entities_of_its_segment_with_their_attributes() -> None:
    rng = random.Random(11)
    world = build([floor()], player="person", spawns=((0.0, 0.0, 0.0),))
    attributes: dict[int, dict[str, Any]] = {}
    log, placed = ChangeLog(world, attributes), set[int]()
    for _ in range(70):
        with contextlib.suppress(OverlapError):
            entity = world.spawn("person", (rng.uniform(-30, 30), rng.uniform(-30, 30), 4.0 * rng.randint(0, 3)))
            attributes[entity] = {"name": f"player {entity}"}
    for _ in range(6):
        world.step()
        log.record()
        keyframes = log.since(KEYFRAME)
        for segment in world.blocks:
            rows = world.in_segment(segment)
            named = [entity for entity in rows[:, ID].tolist() if entity in attributes]
            tables = [part for entity in named for part in (entity, attributes[entity])]
            assert keyframes[segment] == encode_part(segment, KEYFRAME, rows, placed=placed, attributes=tables)
        assert keyframes[(99, 0, 0)] == encode_part((99, 0, 0), KEYFRAME, world.rows([]))
        for entity in rng.sample(sorted(attributes), 20):
            act = rng.randrange(4)
            if act == 0:
                with contextlib.suppress(OverlapError):
                    world.place(entity, (rng.uniform(-30, 30), rng.uniform(-30, 30), 20.0))
                    placed.add(entity)
            elif act == 1:
                world.remove(entity)
                del attributes[entity]
                log.note_removal(entity)
            else:
                attributes[entity] = {"name": "another", "score": rng.randrange(300)} if act == 2 else {}
                log.note_attributes(entity)


def test_a_keyframe_that_cannot_be_encoded_leaves_the_others() -> None:
    world = build([floor()], player="person", spawns=((0.0, 0.0, 0.0),))
    entity = world.spawn("person", (3.0, 3.0, 0.0))
    log = ChangeLog(world, {entity: {"wrong": object()}})
    world.step()
    log.record()
    parts = log.since(KEYFRAME)
    assert {segment for segment in world.blocks if not parts[segment]} == {log.segment(entity)}
