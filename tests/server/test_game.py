"""Clients come, play, misbehave and go; the tick goes on."""

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.game import Game
from server.limits import Limits
from server.replication import HISTORY
from server.session import Session
from shared import edits, messages
from shared.edits import Edit
from shared.messages import (
    Bye,
    Command,
    Hello,
    Inputs,
    Message,
    Ping,
    Pong,
    Resync,
    Snapshot,
    Terrain,
    Welcome,
    decode_from_server,
    encode,
)
from tests.worlds import EAST, STEP, scene

HELLO = Hello(messages.VERSION, {}, "")
FLOOR = [[0, 0, 0, 32, 32, 1, 1]]


class FakeLink:
    """Keeps what it is sent; may call back while it is being closed, as a link is free to do."""

    def __init__(self, table: "Table", *, calls_back: bool = False) -> None:
        self.table = table
        self.calls_back = calls_back
        self.sent: list[Message] = []
        self.closings: list[tuple[int, str]] = []
        self.waiting = 0
        self.session: Session

    def send(self, message: bytes) -> None:
        assert len(message) <= messages.MESSAGE_MAX
        self.sent.append(decode_from_server(message))

    def outstanding(self) -> int:
        return self.waiting

    def close(self, code: int, reason: str) -> None:
        self.closings.append((code, reason))
        if self.calls_back:
            self.table.game.lost(self.session, self.table.now)

    def say(self, *said: Message | bytes) -> None:
        for message in said:
            data = message if isinstance(message, bytes) else encode(message)
            self.table.game.receive(self.session, data, self.table.now)

    def got(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.sent if isinstance(message, kind)]

    def refusal(self) -> tuple[int, str]:
        """With what it was closed, having been told the same in a `Bye`."""
        ((code, reason),) = self.closings
        assert self.sent[-1] == Bye(code, reason, -1.0)
        return code, reason


class Table:
    """A game and its time."""

    def __init__(self, limits: Limits | None = None, fill: list[list[int]] = FLOOR, **changes: Any) -> None:
        values: dict[str, Any] = {"origin": (0, 0, 0), "size": (1, 1, 1), "spawns": ((16.0, 16.0, 1.0),)}
        self.game = Game(scene(fill, **(values | changes)), limits=limits, compiled=False)
        self.now = 0.0
        self.tick_s = 1 / self.game.scene.tick_rate

    def connect(self, *said: Message | bytes, calls_back: bool = False) -> FakeLink:
        link = FakeLink(self, calls_back=calls_back)
        link.session = self.game.open(link, self.now)
        link.say(*said)
        return link

    def join(self) -> FakeLink:
        link = self.connect(HELLO)
        self.tick()
        assert link.session.entity
        return link

    def tick(self, n: int = 1) -> None:
        for _ in range(n):
            self.now += self.tick_s
            self.game.tick(self.now, self.now)

    def lose(self, link: FakeLink) -> None:
        self.game.lost(link.session, self.now)

    @property
    def tick_number(self) -> int:
        return self.game.world.tick


@pytest.fixture
def table() -> Table:
    return Table()


# -- the handshake -------------------------------------------------------------------------------------------


def test_who_says_hello_is_welcomed_and_shown_the_world_in_the_next_tick(table: Table) -> None:
    link = table.connect(HELLO)
    assert (link.sent, len(table.game.world)) == ([], 0)
    table.tick()
    welcome, snapshot, terrain = link.sent[:3]
    assert welcome == Welcome(1, 0, 1, table.game.scene.to_table())
    assert isinstance(snapshot, Snapshot)
    assert isinstance(terrain, Terrain)
    assert (snapshot.tick, snapshot.newest, len(snapshot.fates), len(snapshot.segments)) == (1, -1, 1, 1)
    table.tick()
    assert link.got(Snapshot)[-1].tick == 2
    assert table.game.counters.joined == 1


def test_a_client_of_another_version_is_told_which_one_is_spoken(table: Table) -> None:
    code, reason = table.connect(Hello(7, {}, "")).refusal()
    assert (code, reason) == (messages.WRONG_VERSION, "protocol version 7: this server speaks 1")


def test_a_client_of_the_same_scene_may_say_so(table: Table) -> None:
    link = table.connect(Hello(1, table.game.scene.digests, ""))
    table.tick()
    assert link.session.entity


def test_a_client_of_another_scene_is_told_which_fields_differ(table: Table) -> None:
    other = scene(gravity=9.0, tick_rate=32, origin=(0, 0, 0), size=(1, 1, 1), spawns=((16.0, 16.0, 1.0),))
    code, reason = table.connect(Hello(1, other.digests, "")).refusal()
    assert (code, reason) == (messages.WRONG_SCENE, "another scene: gravity, terrain, tick_rate differ(s)")


def test_a_field_that_only_one_side_has_differs_too(table: Table) -> None:
    mine = table.game.scene.digests
    code, reason = table.connect(Hello(1, mine | {"wind": b"1"}, "")).refusal()
    assert (code, reason) == (messages.WRONG_SCENE, "another scene: wind differ(s)")
    long = {f"{i:02}" + "x" * 200: b"" for i in range(32)}
    assert len(table.connect(Hello(1, long, "")).refusal()[1]) <= messages.REASON_MAX


@pytest.mark.parametrize(
    "said",
    [
        (HELLO, HELLO), (Inputs(1, -1, bytes(3)),), (Command(1, 1, 0.0, "edit", b""),), (Resync(),),
        (HELLO, Inputs(1, -1, bytes(3))), (b"",), (b"\xff" * 40,), (bytes(9000),), (encode(Pong(1.0, 1.0)),),
    ],
    ids=lambda said: f"{said}"[:40],
)  # fmt: skip
def test_what_is_out_of_place_or_malformed_ends_the_connection(table: Table, said: tuple[Message | bytes, ...]) -> None:
    link = table.connect(*said)
    code, reason = link.refusal()
    assert code == messages.MALFORMED
    assert reason
    link.say(HELLO, b"and more")
    table.tick(2)
    assert len(link.closings) == 1
    assert table.game.counters.kicked == 1


def test_hello_in_the_middle_of_the_game_ends_it(table: Table) -> None:
    link = table.join()
    link.say(HELLO)
    assert link.refusal() == (messages.MALFORMED, "Hello at this point")


def test_goodbye_is_answered_by_closing(table: Table) -> None:
    link = table.join()
    link.say(Bye(1000, "", -1.0), Ping(1.0))
    assert link.closings == [(messages.GOING_AWAY, "goodbye")]
    assert link.got(Pong) == []


def test_a_ping_is_answered_with_the_time_before_and_after_joining(table: Table) -> None:
    table.tick(3)
    link = table.connect(Ping(0.5))
    table.now += table.tick_s / 4
    link.say(Ping(-7))
    assert link.sent == [Pong(0.5, 3.0), Pong(-7, 3.25)]


# -- limits --------------------------------------------------------------------------------------------------


def test_a_full_server_refuses_and_is_not_full_any_more_when_someone_leaves() -> None:
    table = Table(Limits(clients_max=2))
    first, _ = table.connect(), table.connect()
    assert table.connect().refusal() == (messages.FULL, "the server is full (2 clients)")
    table.lose(first)
    assert table.connect().closings == []  # who was refused and has not hung up yet takes no place


def test_with_no_room_to_spawn_one_is_refused() -> None:
    table = Table(fill=[[0, 0, 0, 32, 32, 32, 1]], spawns=((16.0, 16.0, 16.0),))
    link = table.connect(HELLO)
    table.tick()
    assert link.refusal() == (messages.FULL, "no room to spawn")
    assert len(table.game.world) == 0


def test_no_two_players_share_a_place(table: Table) -> None:
    links = [table.connect(HELLO) for _ in range(12)]
    table.tick(12)
    places = {table.game.world.position(link.session.entity) for link in links}
    assert len(places) == 12


def test_who_does_not_say_hello_is_closed_even_while_pinging() -> None:
    table = Table(Limits(hello_s=1.0))
    link = table.connect()
    for _ in range(64):
        link.say(Ping(0.0))
        table.tick()
        assert not link.closings
    table.tick()
    assert link.refusal() == (messages.NO_HELLO, "no hello within 1 s")


def test_who_says_nothing_any_more_is_closed_and_who_pings_is_not() -> None:
    table = Table(Limits(silence_s=1.0))
    silent, alive = table.join(), table.join()
    for _ in range(70):
        alive.say(Ping(0.0))
        table.tick()
    assert silent.refusal() == (messages.TOO_SLOW, "nothing heard for 1 s")
    assert alive.closings == []


def test_who_reads_nothing_is_closed() -> None:
    table = Table(Limits(stalled_s=1.0))
    link = table.join()
    link.waiting = 1 << 20
    for _ in range(66):
        link.say(Ping(0.0))
        table.tick()
    assert link.refusal() == (messages.TOO_SLOW, "nothing read for 1 s")


def test_a_flood_of_messages_is_closed_and_a_burst_is_not() -> None:
    table = Table(Limits(messages_per_tick=4))
    link = table.join()
    for _ in range(3):
        link.say(*[Ping(0.0)] * 128)
        assert link.closings == []
        table.tick(32)  # the allowance is back
    link.say(*[Ping(0.0)] * 129)
    assert link.refusal() == (messages.MALFORMED, "too many messages")


# -- the tick ------------------------------------------------------------------------------------------------


def test_an_input_moves_the_player_in_its_tick(table: Table) -> None:
    link = table.join()
    link.say(Inputs(3, 1, bytes((127, 0, 0))))
    table.tick()
    assert table.game.world.position(1)[0] == 16
    table.tick()
    assert table.game.world.position(1)[0] == 16 + 3 / 64
    snapshot = link.got(Snapshot)[-1]
    assert (snapshot.newest, snapshot.first, snapshot.fates) == (3, 3, bytes([messages.USED]))


def test_who_leaves_is_gone_before_who_comes_is_placed(table: Table) -> None:
    first = table.join()
    table.lose(first)
    second = table.connect(HELLO)
    table.tick()
    assert 1 not in table.game.world
    assert (second.session.entity, table.game.world.position(2)) == (2, (16.0, 16.0, 1.0))
    assert table.game.counters.left == 1


def test_the_others_see_who_came_and_who_left(table: Table) -> None:
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


def test_who_falls_out_comes_back_at_a_spawn_and_is_said_to_have_been_placed(table: Table) -> None:
    link = table.join()
    table.game.world.place(1, (31.0, 31.0, -40.0))
    table.tick()
    assert table.game.counters.fell_out == 1
    table.tick()
    assert table.game.world.position(1) == (16.0, 16.0, 1.0)
    assert table.game.world.velocity(1) == (0.0, 0.0, 0.0)
    assert link.got(Snapshot)[-1].segments[-1][4][5] & 4


def test_who_falls_out_and_leaves_does_not_come_back(table: Table) -> None:
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
    # All in one and the same tick, though each took itself off the list.
    assert len({len(link.got(Snapshot)) for link in links[:3]}) == 1
    assert (table.game.sessions, len(table.game.world)) == ([], 0)


def test_when_the_server_goes_down_everyone_is_told_when_to_come_back(table: Table) -> None:
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
    other.say(Inputs(table.tick_number + 1, -1, bytes(EAST)))
    seen = len(link.sent)
    table.tick(5)
    assert (len(link.sent), link.session.skipped, len(other.got(Snapshot))) == (seen, 5, 11)
    link.waiting = 0
    table.tick()
    snapshot = link.got(Snapshot)[-1]
    assert (snapshot.first, len(snapshot.fates), ids(snapshot)) == (snapshot.tick - 5, 6, [2])
    assert [part[3] for part in snapshot.segments] == [snapshot.tick - 6]
    assert table.game.counters.snapshots_skipped == 5


@pytest.mark.parametrize(("skipped", "keyframe"), [(HISTORY - 1, False), (HISTORY, True)])
def test_a_link_that_was_full_for_too_long_gets_everything_anew(table: Table, skipped: int, keyframe: bool) -> None:
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


def test_an_endless_plea_for_everything_anew_is_granted_rarely(table: Table) -> None:
    link = table.join()
    table.tick(8)
    before = table.game.counters.terrain_bytes
    for _ in range(64):
        link.say(Resync(), Resync())
        table.tick()
    assert table.game.counters.terrain_bytes - before < 3 * len(table.game.log.packed((0, 0, 0)))


# -- commands ------------------------------------------------------------------------------------------------


def edit(number: int, tick: int, *block: int) -> Command:
    return Command(number, tick, 0.0, edits.NAME, edits.pack(Edit(*block)))


def builder(table: Table) -> FakeLink:
    """A client that has been there long enough to have some edits free."""
    link = table.join()
    table.tick(64)
    return link


def verdicts(link: FakeLink) -> dict[int, int]:
    told: dict[int, int] = {}
    for snapshot in link.got(Snapshot):
        for at in range(0, len(snapshot.verdicts), 5):
            number = int.from_bytes(snapshot.verdicts[at : at + 4], "little")
            assert number not in told
            told[number] = snapshot.verdicts[at + 4]
    return told


def test_an_edit_is_carried_out_in_its_tick_and_answered(table: Table) -> None:
    link = builder(table)
    tick = table.tick_number
    link.say(edit(1, tick + 2, 18, 16, 1, 5), edit(2, tick, 14, 16, 1, 6))
    table.tick()
    assert table.game.world.blocks.get(18, 16, 1) == 0
    table.tick()
    assert [table.game.world.blocks.get(*at) for at in ((18, 16, 1), (14, 16, 1))] == [5, 6]
    assert verdicts(link) == {1: messages.DONE, 2: messages.DONE}


def test_each_edit_that_cannot_be_done_says_why(table: Table) -> None:
    link = builder(table)
    link.say(
        edit(1, 0, 16, 16, 1, 5),
        edit(2, 0, 30, 16, 1, 5),
        edit(3, 0, 16, 16, -3, 5),
        Command(4, 0, 0.0, edits.NAME, b"\xff"),
        Command(5, 0, 0.0, "fly", b""),
        edit(6, table.tick_number + 100, 18, 16, 1, 5),
    )
    table.tick(2)
    told = verdicts(link)
    assert told[1] in (messages.OVERLAPS, messages.DONE)
    assert told[2] == messages.OUT_OF_REACH
    assert {told[number] for number in (3, 4, 5)} == {messages.INVALID}
    assert told[6] == messages.TOO_MANY


def test_a_command_counts_once(table: Table) -> None:
    link = builder(table)
    link.say(edit(5, 0, 18, 16, 1, 5), edit(5, 0, 18, 16, 1, 0), edit(4, 0, 18, 16, 1, 0))
    table.tick(2)
    assert (verdicts(link), table.game.world.blocks.get(18, 16, 1)) == ({5: messages.DONE}, 5)


def test_commands_are_bounded_in_number_and_rate() -> None:
    table = Table(Limits(commands_waiting_max=4, edits_per_s=1.0))
    link = table.join()
    tick = table.tick_number
    link.say(*[edit(n, tick + 2, 18, 16, 1 + n, 5) for n in range(1, 9)])
    assert len(link.session.commands) == 4
    table.tick(3)
    assert sorted(verdicts(link)) == list(range(1, 9))
    assert [verdicts(link)[n] for n in range(5, 9)] == [messages.TOO_MANY] * 4
    assert sum(verdict == messages.DONE for verdict in verdicts(link).values()) <= 1


def test_what_a_client_ordered_before_it_was_closed_is_not_carried_out(table: Table) -> None:
    link = table.join()
    link.say(edit(1, table.tick_number + 1, 18, 16, 1, 5), b"\xff")
    table.tick(2)
    assert table.game.world.blocks.get(18, 16, 1) == 0


# -- any client ----------------------------------------------------------------------------------------------

spoken = st.one_of(
    st.binary(max_size=30),
    st.just(HELLO).map(encode),
    st.builds(Inputs, st.integers(0, 300), st.integers(-1, 300), st.integers(0, 64).map(lambda n: bytes(3 * n))).map(
        encode
    ),
    st.builds(Ping, st.floats(allow_nan=False, allow_infinity=False)).map(encode),
    st.builds(
        lambda number, tick, *block: encode(edit(number, tick, *block)),
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


@settings(derandomize=True, deadline=None, max_examples=60)
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
    """A short game of eight who walk, dig, leave and come; its hashes."""
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
            link.say(Inputs(tick + rng.randrange(6), -1, rows), edit(tick, tick + 1, *block, rng.randrange(3)))
            if rng.random() < 0.05:
                table.lose(link)
                links.remove(link)
        table.tick()
        hashes.append(table.game.world.state_hash())
    return hashes


def test_the_same_seed_gives_the_same_game() -> None:
    assert play(3) == play(3)
    assert play(3)[-1] != play(4)[-1]


def ids(snapshot: Snapshot) -> list[int]:
    """Who is told of, without regard to segments."""
    rows = b"".join(part[4] for part in snapshot.segments)
    return [int.from_bytes(rows[at : at + 4], "little") for at in range(0, len(rows), 33)]


def gone(snapshot: Snapshot) -> list[int]:
    packed = b"".join(part[5] for part in snapshot.segments)
    return [int.from_bytes(packed[at : at + 4], "little") for at in range(0, len(packed), 4)]
