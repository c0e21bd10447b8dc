"""The two worlds of one client, in cases made by hand: what is replayed, what is counted, and the result."""

from collections.abc import Iterable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from client_sdk.prediction.confirmed import Confirmed
from client_sdk.prediction.prediction import NONDETERMINISM, Prediction
from client_sdk.replica import check_scene
from shared.checks import Cell
from shared.edits import Edit
from shared.inputs import NEUTRAL, Input
from shared.messages import ProtocolError, Snapshot
from shared.scene import Scene
from shared.snapshot import checksum, encode_part
from shared.world import World
from tests.worlds import EAST, NORTH, WEST, scene

ME, OTHER = 1, 2
HERE, BESIDE = (0, 0, 0), (1, 0, 0)
FLOOR = [0, 0, 0, 64, 32, 1, 1]


def ground() -> Scene:
    return scene([FLOOR], origin=(0, 0, 0), size=(2, 1, 1), spawns=((16.0, 16.0, 1.0),))


class Pair:
    """A server's world, and the prediction of the client whose entity is `ME`."""

    def __init__(
        self, *others: tuple[float, float, float], shown: str = "interpolated", walk_speed: float = 3.0, **options: Any
    ) -> None:
        walks = ground().with_changes("box", walk_speed=walk_speed)
        self.server = World(walks, compiled=False)
        self.server.load_terrain()
        self.server.spawn("box", (16, 16, 1))
        for place in others:
            self.server.spawn("box", place)
        self.confirmed_copy = Confirmed(walks.with_changes("box", shown=shown), ME, compiled=False)
        self.client = Prediction(self.confirmed_copy, **options)
        for segment in (HERE, BESIDE):
            self.confirmed_copy.load_segment(segment, self.server.blocks.segment(segment).reshape(-1))
        self.settle()
        self.tell(since=-1)
        self.client.begin(self.server.tick)

    def settle(self) -> None:
        for _ in range(4):
            self.server.step()

    def ahead(self, *wishes: Input) -> None:
        """Steps the prediction with these inputs."""
        for input_ in wishes:
            self.client.file(self.client.predicted.tick + 1, input_)
            self.client.step()

    def act(self, *wishes: Input, others: Input = NEUTRAL) -> None:
        """Steps the server's world with these inputs."""
        for input_ in wishes:
            self.server.step({e: input_ if e == ME else others for e in self.server.entities["id"].tolist()})

    def tell(self, since: int = 0, segments: Iterable[Cell] = (HERE, BESIDE), **fields: Any) -> str:
        """Applies a snapshot of these segments to the client, with all changes. Returns the result of
        `Confirmed.apply`."""
        parts = [
            msgpack.unpackb(encode_part(segment, since, self.server.in_segment(segment), **fields))
            for segment in segments
        ]
        return self.confirmed_copy.apply(snapshot(self.server.tick, parts))

    def reconcile(self, *, late: bool = False) -> Any:
        done = self.client.reconcile(late)
        assert self.client.predicted.tick >= self.client.confirmed.tick
        return done

    def assert_agreed(self) -> None:
        """Checks that the confirmed world equals the server's world, to the bit."""
        assert self.client.confirmed.state_hash() == self.server.state_hash()


def snapshot(tick: int, parts: list[Any], drops: Iterable[Cell] = ()) -> Snapshot:
    return Snapshot(tick, -1, b"", -1, b"", b"", np.array(list(drops), "<i4").tobytes(), tuple(parts))


# -- a right prediction --------------------------------------------------------------------------------------


def test_a_right_prediction_is_left_alone() -> None:
    pair = Pair((20, 20, 1))
    pair.ahead(EAST, NORTH, EAST, EAST)
    pair.act(EAST, NORTH)
    before = pair.client.predicted.state_hash()
    pair.tell()
    done = pair.reconcile()
    assert (done.correction, done.repredicted, done.replayed, done.offsets) == (None, False, 0, {})
    assert pair.client.predicted.state_hash() == before
    pair.assert_agreed()


def test_a_snapshot_is_compared_once() -> None:
    pair = Pair()
    pair.ahead(EAST)
    pair.act(NORTH)
    pair.tell()
    assert pair.reconcile(late=True).correction
    assert pair.reconcile(late=True).correction is None


def test_before_it_has_begun_and_behind_the_server_nothing_is_compared() -> None:
    pair = Pair()
    pair.act(EAST, EAST, EAST)
    pair.tell()
    done = pair.client.reconcile(late=False)
    assert (done.correction, done.replayed) == (None, 0)


def test_a_sync_test_changes_nothing() -> None:
    pair = Pair((17, 16, 1))
    pair.ahead(*[EAST] * 9)
    before = pair.client.predicted.state_hash()
    pair.client.sync_test()
    assert pair.client.predicted.state_hash() == before


# -- a wrong prediction --------------------------------------------------------------------------------------


def test_a_wall_that_the_client_lacks_corrects_it_to_the_bit_and_is_counted() -> None:
    pair = Pair()
    pair.server.set_block(17, 16, 1, 4)  # the box ends at 16.625
    pair.ahead(*[EAST] * 20)
    pair.act(*[EAST] * 10)
    pair.tell()
    done = pair.reconcile()
    correction = done.correction
    assert correction is not None
    assert (correction.tick, correction.ticks) == (pair.server.tick, 10)
    assert correction.fields == ("x", "vx")
    assert correction.blocks == 10 * 3 / 64 - 3 / 8
    assert (done.replayed, done.repredicted) == (10, False)
    # The client does not know the wall yet, so it walks on from there; with the edit it does not.
    assert pair.client.predicted.position(ME)[0] == 17 - 5 / 8 + 10 * 3 / 64
    pair.act(EAST)
    pair.tell(edits=[(1 << 10 | 16 << 5 | 17, 4)], segments=[HERE])
    assert pair.reconcile().correction.cause == "unknown edit"
    assert pair.client.predicted.position(ME)[0] == 17 - 5 / 8
    pair.assert_agreed()


def test_after_a_correction_the_replay_is_what_the_server_will_compute() -> None:
    pair = Pair()
    wishes = [EAST, EAST, NORTH, EAST, NORTH, NORTH]
    pair.ahead(*wishes)
    pair.act(NORTH)  # an input that arrived too late
    pair.tell()
    done = pair.reconcile(late=True)
    assert done.correction.cause == "late input"
    assert set(done.offsets) == {ME}
    pair.act(*wishes[1:])
    assert pair.client.predicted.state_hash() == pair.server.state_hash()


@pytest.mark.parametrize(("shown", "drawn_ahead"), [("interpolated", set()), ("predicted", {OTHER})])
def test_a_new_input_of_another_entity_is_a_reprediction_and_no_correction(shown: str, drawn_ahead: set[int]) -> None:
    pair = Pair((20, 20, 1), shown=shown)
    pair.ahead(EAST, EAST, EAST)
    pair.act(EAST, others=NORTH)
    pair.tell()
    done = pair.reconcile()
    assert (done.correction, done.repredicted, done.replayed, set(done.offsets)) == (None, True, 2, drawn_ahead)
    pair.act(EAST, EAST, others=NORTH)
    assert pair.client.predicted.state_hash() == pair.server.state_hash()


@pytest.mark.parametrize(
    ("blocks", "ahead", "shown", "walk_speed", "edits", "counts"),
    [
        (4, 3, "interpolated", 3.0, False, True),
        (8, 3, "interpolated", 3.0, False, False),
        (8, 30, "interpolated", 3.0, False, True),
        (8, 3, "interpolated", 12.0, False, True),
        (8, 3, "predicted", 3.0, False, True),
        (8, 3, "interpolated", 3.0, True, True),
        (14, 99, "interpolated", 3.0, False, False),
    ],
)
def test_another_entity_counts_if_it_can_be_met_before_the_next_replay(
    blocks: int, ahead: int, shown: str, walk_speed: float, edits: bool, counts: bool
) -> None:
    """It also counts if it may be in the way of an edit, or is drawn as predicted."""
    pair = Pair((16 + blocks, 16, 1), shown=shown, walk_speed=walk_speed)
    if edits:
        pair.client.edit(1, ahead + 99, Edit(20, 16, 1, 4))
    pair.ahead(*[NEUTRAL] * ahead)
    pair.act(NEUTRAL, others=NORTH)
    pair.tell()
    assert pair.reconcile().repredicted == counts


def test_what_was_too_far_away_to_count_does_so_once_it_comes_near() -> None:
    pair = Pair((22, 16, 1))
    replays, ticks = [], 64
    for tick in range(ticks):
        pair.ahead(*[EAST] * (4 if tick == 0 else 1))
        pair.act(EAST, others=WEST if tick > 2 else NEUTRAL)
        pair.tell()
        done = pair.reconcile()
        assert done.correction is None
        replays += [tick] * done.repredicted
    (replay,) = replays
    assert 3 < replay < ticks - 1
    assert pair.server.position(OTHER)[0] - pair.server.position(ME)[0] == 5 / 8  # they have met


def test_a_correction_by_another_entity_has_that_cause() -> None:
    pair = Pair((16.75, 16, 1))  # an eighth of a block away
    pair.ahead(*[EAST] * 8)
    pair.act(*[EAST] * 8, others=EAST)
    pair.tell()
    assert pair.reconcile().correction.cause == "other entity"


def test_a_correction_that_nothing_explains_is_an_alarm() -> None:
    pair = Pair()
    pair.ahead(EAST, EAST)
    pair.act(NORTH)
    pair.tell()
    assert pair.reconcile().correction.cause == NONDETERMINISM


def test_an_act_of_the_rules_is_named_as_the_cause() -> None:
    pair = Pair()
    pair.ahead(EAST, EAST)
    pair.server.place(ME, (5, 5, 1))
    pair.act(EAST)
    pair.tell(acted={ME})
    done = pair.reconcile()
    assert (done.correction.cause, ME in done.acted) == ("server act", True)
    pair.ahead(EAST)
    pair.act(EAST)
    pair.tell()
    assert pair.reconcile().acted == frozenset()


def test_when_the_own_entity_is_not_there_others_go_on() -> None:
    pair = Pair((20, 20, 1))
    pair.ahead(EAST, EAST, EAST)
    pair.server.remove(ME)
    pair.act(NEUTRAL, others=NORTH)
    pair.tell(gone=[ME], segments=[HERE])
    done = pair.reconcile()
    assert (done.correction, ME in pair.client.predicted, OTHER in pair.client.predicted) == (None, False, True)
    pair.ahead(EAST)
    pair.assert_agreed()


# -- interest ------------------------------------------------------------------------------------------------


def test_a_keyframe_removes_the_other_entities_of_its_segment_only() -> None:
    pair = Pair((20, 20, 1), (40, 20, 1), (41, 22, 1))
    for entity in (2, 3):
        pair.server.remove(entity)
    pair.act(NEUTRAL)
    pair.tell(since=-1, segments=[HERE])
    assert pair.client.confirmed.entities["id"].tolist() == [1, 3, 4]
    pair.tell(since=-1, segments=[BESIDE])
    pair.assert_agreed()


def test_an_entity_that_left_for_an_unseen_segment_is_gone_and_one_that_came_stays() -> None:
    pair = Pair((20, 20, 1), (22, 22, 1))
    pair.server.place(2, (40, 20, 1))
    pair.act(NEUTRAL)
    pair.tell(segments=[HERE], gone=[2])
    assert pair.client.confirmed.entities["id"].tolist() == [1, 3]
    pair.act(NEUTRAL)
    pair.tell(segments=[HERE, BESIDE], gone=[2])  # an outdated part: it is in the segment beside by now
    pair.assert_agreed()


def test_a_dropped_segment_is_forgotten_with_all_that_is_in_it() -> None:
    pair = Pair((20, 20, 1), (40, 20, 1))
    pair.act(NEUTRAL)
    pair.confirmed_copy.apply(snapshot(pair.server.tick, [], drops=[BESIDE]))
    assert pair.client.confirmed.entities["id"].tolist() == [1, 2]
    assert list(pair.client.confirmed.blocks) == [HERE]
    assert not pair.confirmed_copy.grounded()


def test_an_entity_that_walks_out_of_a_dropped_segment_into_a_seen_one_stays() -> None:
    pair = Pair((40, 20, 1))
    pair.server.place(OTHER, (20, 20, 1))
    pair.act(NEUTRAL)
    part = msgpack.unpackb(encode_part(HERE, 3, pair.server.in_segment(HERE)))
    pair.confirmed_copy.apply(snapshot(pair.server.tick, [part], drops=[BESIDE]))
    assert pair.client.confirmed.states().tolist() == pair.server.states().tolist()


def test_terrain_that_comes_is_a_reason_to_replay() -> None:
    pair = Pair()
    pair.ahead(EAST, EAST)
    pair.act(EAST)
    pair.confirmed_copy.load_segment(BESIDE, np.zeros(32768, np.uint8))
    pair.tell()
    done = pair.reconcile()
    assert (done.correction, done.repredicted, done.replayed) == (None, True, 1)
    assert pair.client.predicted.blocks.get(40, 16, 0) == 0


def test_a_copy_that_is_not_the_servers_is_noticed() -> None:
    pair = Pair()
    pair.act(EAST)
    assert pair.tell(segments=[HERE], check=checksum(pair.server, HERE)) == ""
    pair.server.set_block(9, 9, 9, 1)  # and nothing reports it
    pair.act(EAST)
    assert "(0, 0, 0)" in pair.tell(segments=[HERE], check=checksum(pair.server, HERE))


# -- edits ---------------------------------------------------------------------------------------------------


def test_an_edit_is_there_at_once_and_again_after_a_replay() -> None:
    pair = Pair()
    pair.client.edit(1, pair.client.next_order, Edit(17, 16, 1, 4))
    pair.ahead(*[EAST] * 12)
    assert pair.client.predicted.position(ME)[0] == 17 - 5 / 8
    pair.client.sync_test()
    assert pair.client.predicted.position(ME)[0] == 17 - 5 / 8
    assert pair.client.confirmed.blocks.get(17, 16, 1) == 0


def test_an_edit_that_was_refused_is_undone_with_all_it_did() -> None:
    pair = Pair()
    pair.client.edit(1, pair.client.next_order, Edit(17, 16, 1, 4))
    pair.ahead(*[EAST] * 12)
    pair.act(EAST)
    pair.client.settle(1, done=False)
    pair.tell()
    assert pair.reconcile().replayed == 11
    assert pair.client.predicted.blocks.get(17, 16, 1) == 0
    assert pair.client.predicted.position(ME)[0] == 16 + 12 * 3 / 64


# -- without neighbours --------------------------------------------------------------------------------------


def test_without_neighbours_only_the_own_entity_is_predicted_and_compared() -> None:
    pair = Pair((20, 20, 1), neighbours=False)
    pair.ahead(EAST, EAST)
    assert pair.client.predicted.entities["id"].tolist() == [ME]
    pair.act(EAST, others=NORTH)
    pair.tell()
    assert pair.reconcile().replayed == 0
    pair.assert_agreed()


# -- malformed -----------------------------------------------------------------------------------------------


def test_a_malformed_part_changes_nothing() -> None:
    pair = Pair((20, 20, 1))
    before = pair.client.confirmed.state_hash()
    pair.act(EAST)
    good = msgpack.unpackb(encode_part(HERE, 0, pair.server.in_segment(HERE)))
    with pytest.raises(ProtocolError):
        pair.confirmed_copy.apply(snapshot(pair.server.tick, [good, [*good[:6], bytes(33), *good[7:]]], drops=[BESIDE]))
    assert pair.client.confirmed.state_hash() == before


TABLES = st.dictionaries(
    st.sampled_from(sorted(ground().to_table())),
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.binary(max_size=5),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=6,
    ),
    max_size=3,
)


@given(TABLES)
def test_any_table_is_a_scene_or_a_protocol_error(changes: dict[str, Any]) -> None:
    try:
        assert check_scene(ground().to_table() | changes).fingerprint
    except ProtocolError as error:
        assert str(error).startswith("Welcome.scene: ")  # noqa: PT017
