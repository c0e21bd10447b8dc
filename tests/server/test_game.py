"""The tick: joins, leaves, slow links and clients that send anything."""

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.config.limits import Limits
from shared import messages
from shared.bounds import bounds
from shared.inputs import row
from shared.messages import Bye, Command, Inputs, Ping, Resync, Snapshot, Terrain, encode
from tests.lengths import examples
from tests.tables import HELLO, FakeLink, Table, gone, ids, order
from tests.worlds import EAST, STEP

HISTORY = bounds(64).history


@pytest.fixture
def table() -> Table:
    return Table()


# -- the tick ------------------------------------------------------------------------------------------------


def test_an_input_moves_the_player_in_its_tick(table: Table) -> None:
    link = table.join()
    link.say(Inputs(3, 1, bytes((127, 0, 0))))
    table.tick()
    assert table.game.world.position(1)[0] == 16
    table.tick()
    assert table.game.world.position(1)[0] == 16 + 3 / 64
    snapshot = link.got(Snapshot)[-1]
    assert (snapshot.newest, snapshot.first, snapshot.statuses) == (3, 3, bytes([messages.USED]))


def test_leaving_players_are_removed_before_joining_ones_are_placed(table: Table) -> None:
    first = table.join()
    table.lose(first)
    second = table.connect(HELLO)
    table.tick()
    assert 1 not in table.game.world
    assert (second.session.entity, table.game.world.position(2)) == (2, (16.0, 16.0, 1.0))
    assert table.game.counters.left == 1


def test_the_others_see_joins_and_leaves(table: Table) -> None:
    watcher, other = table.join(), table.join()
    assert ids(watcher.got(Snapshot)[-1]) == [2]
    table.lose(other)
    table.tick()
    assert gone(watcher.got(Snapshot)[-1]) == [2]


def test_lost_is_harmless_before_hello_between_hello_and_tick_and_twice(table: Table) -> None:
    silent, greeting, playing = table.connect(), table.connect(HELLO), table.join()
    for link in (silent, greeting, playing):
        for _ in range(2):
            table.lose(link)
    table.tick(2)
    assert (len(table.game.world), table.game.sessions, table.game.counters.left) == (0, [], 2)
    for link in (silent, greeting, playing):
        link.say(HELLO, Ping(0.0), b"?")
    assert silent.sent == []


def test_an_entity_that_falls_out_returns_to_a_spawn_and_is_flagged_as_placed(table: Table) -> None:
    link = table.join()
    table.game.world.place(1, (31.0, 31.0, -40.0))
    table.tick()
    assert table.game.counters.fell_out == 1
    table.tick()
    assert table.game.world.position(1) == (16.0, 16.0, 1.0)
    assert table.game.world.velocity(1) == (0.0, 0.0, 0.0)
    (rows,) = (part[5] for part in link.got(Snapshot)[-1].segments if any(part[5:6]))
    assert rows[5] & 4


def test_an_entity_that_falls_out_and_leaves_does_not_return(table: Table) -> None:
    link = table.join()
    table.game.world.place(1, (31.0, 31.0, -40.0))
    table.tick()
    table.lose(link)
    table.tick(2)
    assert len(table.game.world) == 0


def test_a_session_that_ends_in_the_middle_of_a_tick_costs_the_others_nothing() -> None:
    table = Table(Limits(hello_s=1.0, silence_s=1.0, stalled_s=1.0))
    links = [table.connect(HELLO, calls_back=True) for _ in range(3)] + [table.connect(calls_back=True)] * 1
    table.tick(80)
    assert [code for link in links for code, _ in link.closings] == [4005, 4005, 4005, 4006]
    # All of them fail in the same tick, and each removes itself from the list.
    assert len({len(link.got(Snapshot)) for link in links[:3]}) == 1
    assert (table.game.sessions, len(table.game.world)) == ([], 0)


def test_a_shutdown_sends_every_client_the_time_to_reconnect(table: Table) -> None:
    links = [table.connect(HELLO, calls_back=i % 2 == 0) for i in range(6)]
    table.tick(6)
    table.game.shut_down("maintenance", 2.5)
    for link in links:
        assert link.sent[-1] == Bye(messages.GOING_AWAY, "maintenance", 2.5)
        assert link.closings == [(messages.GOING_AWAY, "maintenance")]
    table.game.shut_down("again", 1.0)
    assert all(len(link.closings) == 1 for link in links)


# -- slow links ----------------------------------------------------------------------------------------------


def test_a_link_that_is_full_is_skipped_and_catches_up_in_one_snapshot(table: Table) -> None:
    link, other = table.join(), table.join()
    table.tick(5)
    link.waiting = 1 << 20
    other.say(Inputs(table.tick_number + 1, -1, row(EAST)))
    seen = len(link.sent)
    table.tick(5)
    assert (len(link.sent), table.game.counters.snapshots_skipped, len(other.got(Snapshot))) == (seen, 5, 11)
    link.waiting = 0
    table.tick()
    snapshot = link.got(Snapshot)[-1]
    assert (snapshot.first, len(snapshot.statuses), ids(snapshot)) == (snapshot.tick - 5, 6, [2])
    assert [part[3] for part in snapshot.segments] == [6]
    assert table.game.counters.snapshots_skipped == 5


@pytest.mark.parametrize(("skipped", "keyframe"), [(HISTORY - 1, False), (HISTORY, True)])
def test_a_link_that_was_full_for_too_long_gets_keyframes(table: Table, skipped: int, keyframe: bool) -> None:
    link = table.join()
    table.join()
    table.tick(60)
    link.waiting = 1 << 20
    before = len(link.got(Terrain))
    table.tick(skipped)
    link.waiting = 0
    table.game.world.set_velocity(2, (0.0, 0.0, STEP * 1000))
    table.tick()
    snapshot = link.got(Snapshot)[-1]
    assert [part[3] == -1 for part in snapshot.segments] == [keyframe]
    assert ids(snapshot) == ([1, 2] if keyframe else [2])
    assert (len(link.got(Terrain)) > before) is keyframe


def test_terrain_waits_behind_snapshots_within_its_budget() -> None:
    limits = Limits(terrain_chunk_bytes=10, terrain_bytes_per_tick=30)
    table = Table(limits, fill=[[i, j, 0, i + 1, j + 1, 1 + (i * j) % 3, 7] for i in range(32) for j in range(32)])
    link = table.connect(HELLO)
    table.tick(400)
    for before, message in zip(link.sent, link.sent[1:], strict=False):
        if isinstance(message, Terrain) and isinstance(before, Terrain):
            assert message.offset == before.offset + len(before.chunk)
    per_tick = [0]
    for message in link.sent:
        if isinstance(message, Snapshot):
            per_tick.append(0)
        elif isinstance(message, Terrain):
            per_tick[-1] += len(message.chunk)
    (total,) = {piece.total for piece in link.got(Terrain)}
    assert max(per_tick) <= 30
    assert sum(per_tick) == total > 60


def test_repeated_resyncs_are_granted_rarely(table: Table) -> None:
    link = table.join()
    table.tick(8)
    before = table.game.counters.terrain_bytes
    for _ in range(64):
        link.say(Resync(), Resync())
        table.tick()
    packed = table.game.log.packed((0, 0, 0))
    assert packed is not None
    assert table.game.counters.terrain_bytes - before < 3 * len(packed)


def test_after_a_resync_the_own_segment_comes_first() -> None:
    table = Table(size=(3, 3, 1), fill=[[0, 0, 0, 96, 96, 1, 1]], spawns=((48.0, 48.0, 1.0),))
    link = table.join()
    table.tick(80)
    link.sent.clear()
    link.say(Resync())
    table.tick(80)
    terrain = [(message.x, message.y, message.z) for message in link.got(Terrain)]
    assert terrain[0] == (1, 1, 0)
    assert len(set(terrain)) == 9


# -- any client ----------------------------------------------------------------------------------------------

spoken = st.one_of(
    st.binary(max_size=30),
    st.just(HELLO).map(encode),
    st.builds(Inputs, st.integers(0, 300), st.integers(-1, 300), st.integers(0, 64).map(lambda n: bytes(3 * n))).map(
        encode
    ),
    st.builds(Ping, st.floats(allow_nan=False, allow_infinity=False)).map(encode),
    st.builds(
        lambda number, tick, *block: encode(order(number, tick, *block)),
        st.integers(0, 50), st.integers(-1, 200), *[st.integers(-40, 40)] * 3, st.integers(0, 255),
    ),
    st.builds(Command, st.integers(0, 50), st.integers(-1, 90), st.floats(0, 99), st.text(max_size=9), st.binary()).map(
        encode
    ),
    st.just(Resync()).map(encode),
    st.just(Bye(1000, "", -1.0)).map(encode),
)  # fmt: skip
ACTS = st.one_of(
    st.tuples(st.just("say"), st.integers(0, 3), spoken),
    st.tuples(st.just("tick"), st.integers(1, 70), st.none()),
    st.tuples(st.just("open"), st.booleans(), st.none()),
    st.tuples(st.just("lose"), st.integers(0, 3), st.none()),
    st.tuples(st.just("clog"), st.integers(0, 3), st.integers(0, 1 << 21)),
)


@settings(max_examples=examples(60))
@given(st.lists(ACTS, max_size=30))
def test_nothing_that_clients_do_raises_or_stops_the_tick(acts: list[tuple[str, int, Any]]) -> None:
    table = Table(Limits(clients_max=3, hello_s=2.0, silence_s=3.0, stalled_s=2.0))
    witness = table.join()
    links = [table.connect(HELLO)]
    for act, which, what in acts:
        link = links[which % len(links)]
        match act:
            case "say":
                link.say(what)
            case "tick":
                for _ in range(which):
                    witness.say(Ping(0.0))
                    table.tick()
            case "open":
                links.append(table.connect(HELLO))
                links[-1].calls_back = bool(which)
            case "lose":
                table.lose(link)
            case "clog":
                link.waiting = what
        assert all(len(link.closings) <= 1 for link in links)
    assert [snapshot.tick for snapshot in witness.got(Snapshot)] == list(range(1, table.tick_number + 1))
    table.lose(witness)
    for link in links:
        table.lose(link)
    table.tick()
    assert (table.game.sessions, len(table.game.world)) == ([], 0)


def play(seed: int) -> list[bytes]:
    """Plays a short game of eight clients who walk, dig, leave and join. Returns its hashes."""
    rng = random.Random(seed)
    table = Table(size=(2, 2, 1), fill=[[0, 0, 0, 64, 64, 2, 1]], spawns=((30.0, 30.0, 2.0), (34.0, 34.0, 2.0)))
    links: list[FakeLink] = []
    hashes = []
    for tick in range(120):
        if len(links) < 8:
            links.append(table.connect(HELLO))
        link = rng.choice(links)
        if link.session.entity:
            x, y, z = (int(part) for part in table.game.world.position(link.session.entity))
            rows = bytes(rng.randrange(256) for _ in range(3 * rng.randrange(5)))
            block = (x + rng.randint(-3, 3), y + rng.randint(-3, 3), z + rng.randint(-2, 2))
            link.say(Inputs(tick + rng.randrange(6), -1, rows), order(tick, tick + 1, *block, rng.randrange(3)))
            if rng.random() < 0.05:
                table.lose(link)
                links.remove(link)
        table.tick()
        hashes.append(table.game.world.state_hash())
    return hashes


def test_the_same_seed_gives_the_same_game() -> None:
    assert play(3) == play(3)
    assert play(3)[-1] != play(4)[-1]
