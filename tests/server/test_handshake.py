"""The handshake of clients, and the limits that close a connection."""

import pytest

from server.config.limits import Limits
from server.game.joining import join_welcome
from shared import fields, messages
from shared.messages import Bye, Command, Hello, Inputs, Message, Ping, Pong, Resync, Snapshot, Terrain, Welcome, encode
from tests.tables import HELLO, Table
from tests.worlds import scene


@pytest.fixture
def table() -> Table:
    return Table()


# -- the handshake -------------------------------------------------------------------------------------------


def test_messages_and_names_have_a_longest() -> None:
    table = Table(Limits(message_bytes_max=600, name_max=3))
    assert table.connect(bytes(601)).refusal() == (messages.TOO_BIG, "a message longer than 600 bytes")
    assert table.connect(Hello(messages.VERSION, {}, "Anna")).refusal() == (
        messages.MALFORMED,
        "a name longer than 3 characters",
    )
    link = table.connect(Hello(messages.VERSION, {}, "Ann"))
    table.tick()
    assert link.session.entity
    assert table.game.counters.closed == {messages.TOO_BIG: 1, messages.MALFORMED: 1}


def test_a_hello_is_answered_by_a_welcome_and_a_snapshot_in_the_next_tick(table: Table) -> None:
    link = table.connect(HELLO)
    assert (link.sent, len(table.game.world)) == ([], 0)
    table.tick()
    welcome, snapshot, terrain = link.sent[:3]
    assert isinstance(welcome, Welcome)
    assert welcome == Welcome(messages.VERSION, 0, 1, table.game.scene.to_table(), welcome.resume)
    assert len(welcome.resume) == fields.RESUME_BYTES
    assert isinstance(snapshot, Snapshot)
    assert isinstance(terrain, Terrain)
    assert (snapshot.tick, snapshot.newest, len(snapshot.statuses), len(snapshot.segments)) == (1, -1, 1, 1)
    table.tick()
    assert link.got(Snapshot)[-1].tick == 2
    assert table.game.counters.joined == 1


def test_a_client_of_another_version_gets_the_servers_version(table: Table) -> None:
    code, reason = table.connect(Hello(7, {}, "")).refusal()
    assert code == messages.WRONG_VERSION
    assert reason == f"the client is newer: protocol version 7, the server speaks {messages.VERSION}"


def test_a_client_of_the_same_scene_may_say_so(table: Table) -> None:
    link = table.connect(Hello(messages.VERSION, table.game.scene.digests, ""))
    table.tick()
    assert link.session.entity


def test_a_client_of_another_scene_gets_the_fields_that_differ(table: Table) -> None:
    other = scene(gravity=9.0, tick_rate=32, origin=(0, 0, 0), size=(1, 1, 1), spawns=((16.0, 16.0, 1.0),))
    code, reason = table.connect(Hello(messages.VERSION, other.digests, "")).refusal()
    assert (code, reason) == (
        messages.WRONG_SCENE,
        "the server plays another scene (gravity, terrain, tick_rate differ)",
    )


def test_a_field_that_only_one_side_has_differs_too(table: Table) -> None:
    mine = table.game.scene.digests
    code, reason = table.connect(Hello(messages.VERSION, mine | {"wind": b"1"}, "")).refusal()
    assert (code, reason) == (messages.WRONG_SCENE, "the server plays another scene (wind differ)")
    long = {f"{i:02}" + "x" * 200: b"" for i in range(32)}
    assert len(table.connect(Hello(messages.VERSION, long, "")).refusal()[1]) <= fields.REASON_MAX


@pytest.mark.parametrize(
    "said",
    [
        (HELLO, HELLO), (Inputs(1, -1, bytes(3)),), (Command(1, 1, 0.0, "edit", b""),), (Resync(),),
        (HELLO, Inputs(1, -1, bytes(3))), (b"",), (b"\xff" * 40,), (bytes(8000),), (encode(Pong(1.0, 1.0)),),
    ],
    ids=lambda said: f"{said}"[:40],
)  # fmt: skip
def test_an_unexpected_or_malformed_message_ends_the_connection(
    table: Table, said: tuple[Message | bytes, ...]
) -> None:
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
    assert link.refusal() == (messages.MALFORMED, "unexpected Hello after the join")


def test_a_bye_is_answered_by_closing(table: Table) -> None:
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


def test_reported_corrections_are_summed_up_over_clients_and_connections_and_never_fall(table: Table) -> None:
    first, second, first_again = table.connect(), table.connect(), table.connect()
    for link, counts in ((first, (0, 2, 5, 5, 1)), (second, (0, 3)), (first_again, (5, 6))):
        for count in counts:
            link.say(Ping(0.0, count))
    assert table.game.counters.corrections == 5 + 3 + 1


# -- limits --------------------------------------------------------------------------------------------------


def test_a_full_server_refuses_and_is_not_full_any_more_when_someone_leaves() -> None:
    table = Table(Limits(clients_max=2))
    links = [table.connect(HELLO) for _ in range(3)]
    table.tick()
    assert links[2].refusal() == (messages.FULL, "the server is full (2 clients)")
    table.lose(links[0])
    table.join()  # a refused client that is still connected takes no place
    assert len(table.game.players) == 2


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


def test_a_client_without_a_hello_is_closed_even_while_pinging() -> None:
    table = Table(Limits(hello_s=1.0))
    link = table.connect()
    for _ in range(64):
        link.say(Ping(0.0))
        table.tick()
        assert not link.closings
    table.tick()
    assert link.refusal() == (messages.NO_HELLO, "no hello within 1 s")


def test_a_silent_client_is_closed_and_a_pinging_one_is_not() -> None:
    table = Table(Limits(silence_s=1.0))
    silent, alive = table.join(), table.join()
    for _ in range(70):
        alive.say(Ping(0.0))
        table.tick()
    assert silent.refusal() == (messages.TOO_SLOW, "no message received for 1 s")
    assert alive.closings == []


def test_a_client_that_reads_nothing_is_closed() -> None:
    table = Table(Limits(stalled_s=1.0))
    link = table.join()
    link.waiting = 1 << 20
    for _ in range(66):
        link.say(Ping(0.0))
        table.tick()
    assert link.refusal() == (messages.TOO_SLOW, "the client read nothing for 1 s")


def test_a_flood_of_messages_is_closed_and_a_burst_is_not() -> None:
    table = Table(Limits(messages_per_tick=4))
    link = table.join()
    for _ in range(3):
        link.say(*[Ping(0.0)] * 256)
        assert link.closings == []
        table.tick(64)  # the allowance is back: one second at 64 ticks/s
    link.say(*[Ping(0.0)] * 257)
    assert link.refusal() == (messages.MALFORMED, "too many messages")


def test_a_welcome_joined_from_a_packed_scene_has_the_same_bytes() -> None:
    table = {"name": "flat", "spawns": [[1.0, 2.0, 3.0]] * 99}
    for tick, entity, token in ((0, 1, b""), (1 << 40, 1 << 31, bytes(16)), (127, 128, bytes(range(16)))):
        welcome = messages.Welcome(messages.VERSION, tick, entity, table, token)
        assert join_welcome(tick, entity, messages.pack(table), token) == messages.encode(welcome)
