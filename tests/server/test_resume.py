"""A player whose connection is lost keeps the entity for a while, and reconnects with the token of the latest
welcome."""

import pytest

from server.config.limits import Limits
from server.game.roster import UNACKNOWLEDGED_S
from server.players.player import SETTLED_MAX
from shared import messages
from shared.messages import Bye, Hello, Inputs, Snapshot, Welcome
from tests.server.test_commands import verdicts
from tests.tables import FakeLink, Table, ids, order

KEPT_S = 2.0


@pytest.fixture
def table() -> Table:
    return Table(resume_s=KEPT_S)


def token(link: FakeLink) -> bytes:
    resume: bytes = link.got(Welcome)[-1].resume
    return resume


def back(table: Table, resume: bytes) -> FakeLink:
    link = table.connect(Hello(messages.VERSION, {}, "", resume=resume))
    table.tick()
    return link


def acknowledge(table: Table, link: FakeLink) -> None:
    """Makes the client acknowledge a snapshot, so the server knows that it has got its welcome."""
    link.say(Inputs(table.tick_number + 1, table.tick_number, bytes(3)))


def test_a_player_that_reconnects_in_time_goes_on_as_before(table: Table) -> None:
    link = table.connect(Hello(messages.VERSION, {}, "Ann"))
    table.tick()
    me = link.session.entity
    acknowledge(table, link)
    link.say(Inputs(table.tick_number + 2, table.tick_number, bytes((127, 0, 0)) * 3))
    table.lose(link)
    table.tick(40)
    place = table.game.world.position(me)
    assert place[0] > 16.5, "the inputs that had arrived were used"
    again = back(table, token(link))
    assert again.got(Welcome)[-1].entity == me
    assert table.game.world.position(me) == place
    assert me in ids(again.got(Snapshot)[0])
    assert (table.game.counters.joined, table.game.counters.resumed, table.game.counters.left) == (1, 1, 0)
    assert table.game.players[me].name == "Ann"
    again.say(Inputs(table.tick_number + 1, table.tick_number, bytes((0, 127, 0))))
    table.tick(2)
    assert table.game.world.position(me)[1] > place[1]


def test_a_player_that_reconnects_too_late_joins_anew(table: Table) -> None:
    link = table.join()
    table.lose(link)
    table.tick(int(KEPT_S / table.tick_s) + 2)
    assert len(table.game.world) == 0
    again = back(table, token(link))
    assert again.session.entity not in (0, link.got(Welcome)[0].entity)


def test_a_token_is_good_once(table: Table) -> None:
    link = table.join()
    me, first = link.session.entity, token(link)
    acknowledge(table, link)
    table.lose(link)
    again = back(table, first)
    acknowledge(table, again)
    table.lose(again)
    table.tick()
    assert back(table, first).session.entity not in (0, me)
    assert back(table, token(again)).session.entity == me


def test_a_welcome_that_was_lost_on_its_way_costs_nothing(table: Table) -> None:
    link = table.join()
    me, first = link.session.entity, token(link)
    acknowledge(table, link)
    table.lose(link)
    table.lose(back(table, first))  # the connection is lost before the client gets its new token
    table.tick()
    assert back(table, first).session.entity == me


def test_a_used_token_uses_up_the_ones_before_it(table: Table) -> None:
    """The client that shows it has read its welcome, even if it has not acknowledged a snapshot."""
    link = table.join()
    me, tokens = link.session.entity, [token(link)]
    for _ in range(5):
        table.lose(link)
        link = back(table, tokens[-1])
        assert link.session.entity == me
        tokens.append(token(link))
    assert len(table.game.players[me].tokens) == 2
    for old in tokens[:-2]:
        assert back(table, old).session.entity != me
    assert back(table, tokens[-2]).session.entity == me


def test_a_guessed_token_is_worth_nothing(table: Table) -> None:
    link = table.join()
    table.lose(link)
    for guess in (bytes(16), b"\xff" * 16, bytes(reversed(token(link)))):
        assert back(table, guess).session.entity != link.got(Welcome)[0].entity


def test_a_reconnect_before_the_loss_is_noticed_takes_over(table: Table) -> None:
    link = table.join()
    me = link.session.entity
    again = back(table, token(link))
    assert link.refusal()[0] == messages.TAKEN_OVER
    assert again.session.entity == me
    table.lose(link)
    table.tick(int(KEPT_S / table.tick_s) + 2)
    assert me in table.game.world


@pytest.mark.parametrize("said", [Bye(1000, "", -1.0), b"\xff"], ids=["goodbye", "a broken rule"])
def test_a_player_that_leaves_frees_the_entity_at_once(table: Table, said: Bye | bytes) -> None:
    link = table.join()
    link.say(said)
    table.lose(link)
    table.tick()
    assert len(table.game.world) == 0
    assert back(table, token(link)).session.entity != link.session.entity


def test_a_slow_connection_is_no_fault_of_the_player(table: Table) -> None:
    link = table.join()
    link.waiting = 1 << 20
    while not link.closings:
        link.say(messages.Ping(0.0))
        table.tick()
    assert link.closings[0][0] == messages.TOO_SLOW
    table.lose(link)
    table.tick()
    assert back(table, token(link)).session.entity == 1


def test_a_command_that_is_sent_again_is_done_once_and_answered_again(table: Table) -> None:
    link = table.join()
    table.tick(64)
    acknowledge(table, link)
    link.say(order(1, 0, 18, 16, 1, 5))
    table.tick()
    table.lose(link)
    again = back(table, token(link))
    again.say(order(1, 0, 18, 16, 1, 5), order(2, 0, 18, 16, 1, 0))
    table.tick(2)
    assert verdicts(again) == {1: messages.DONE, 2: messages.DONE}
    assert table.game.world.blocks.get(18, 16, 1) == 0


def test_only_the_latest_verdicts_are_kept(table: Table) -> None:
    link = table.join()
    player = link.session.player
    assert player
    for number in range(SETTLED_MAX + 10):
        player.settle(number, 0)
    assert list(player.settled) == list(range(10, SETTLED_MAX + 10))


def test_a_player_without_an_acknowledgement_is_kept_for_a_moment_only() -> None:
    """Otherwise clients that join and disconnect again and again would fill the world with entities."""
    table = Table(resume_s=10.0)
    silent, known = table.join(), table.join()
    acknowledge(table, known)
    table.lose(silent)
    table.lose(known)
    table.tick(int(UNACKNOWLEDGED_S / table.tick_s) + 1)
    assert list(table.game.players) == [known.session.entity]
    again = back(table, token(known))
    table.lose(again)  # lost before its first acknowledgement over this connection, but the client is known
    table.tick(int(UNACKNOWLEDGED_S / table.tick_s) + 1)
    assert list(table.game.players) == [known.session.entity]


def test_a_reconnect_to_a_full_server_takes_over_the_own_place() -> None:
    table = Table(Limits(clients_max=1), resume_s=10.0)
    link = table.join()
    acknowledge(table, link)
    again = back(table, token(link))  # before the loss is noticed
    assert again.session.entity == link.session.entity
    assert link.refusal()[0] == messages.TAKEN_OVER
    assert back(table, b"").refusal()[0] == messages.FULL


def test_reconnecting_players_make_room_on_a_full_server() -> None:
    table = Table(Limits(clients_max=3), resume_s=10.0)
    links = [table.join() for _ in range(3)]
    for link in (links[1], links[0]):
        acknowledge(table, link)
        table.lose(link)
        table.tick()
    newcomer = table.join()
    assert list(table.game.players) == [link.session.entity for link in (links[0], links[2], newcomer)]
    assert len(table.game.world) == 3
    table.lose(links[2])
    assert back(table, token(links[0])).session.entity == links[0].session.entity, "a return needs no room"
    assert len(table.game.players) == 3
