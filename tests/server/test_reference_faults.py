"""Faults of the reference engine that concern the network; tests/shared has those of its physics."""

import math

import msgpack
import pytest

from shared.messages import Inputs, ProtocolError, Snapshot, decode_from_client
from shared.snapshot import decode_parts
from tests.tables import FLOOR, HELLO, Table, gone, ids

EAST, WEST = bytes((127, 0, 0)), bytes((256 - 127, 0, 0))
WIDE = [[0, 0, 0, 128, 32, 1, 1]]


@pytest.fixture
def table() -> Table:
    return Table()


@pytest.mark.parametrize("field", [1, 2, 3])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300, -0.0, None, "1", [1]])
def test_an_input_with_nan_or_another_no_number_is_refused(field: int, value: object) -> None:
    parts = [2, 5, 4, EAST]
    parts[field] = value
    with pytest.raises(ProtocolError, match="Inputs"):
        decode_from_client(msgpack.packb(parts))


def test_an_older_input_never_overwrites_a_newer_one(table: Table) -> None:
    link = table.join()
    tick = table.tick_number
    link.say(Inputs(tick + 2, 0, EAST), Inputs(tick + 2, 0, WEST), Inputs(tick + 1, 0, WEST))
    table.tick(2)
    assert table.game.world.velocity(1)[0] > 0
    assert link.session.inputs.refused == 2


def test_inputs_move_the_own_entity_and_no_other(table: Table) -> None:
    first, second = table.join(), table.join()
    rest = table.game.world.position(second.session.entity)
    first.say(Inputs(table.tick_number + 1, 0, EAST))
    table.tick()
    assert table.game.world.position(first.session.entity)[0] > 16
    assert table.game.world.position(second.session.entity) == rest


def test_an_input_of_a_player_that_has_left_moves_nothing(table: Table) -> None:
    first = table.join()
    table.lose(first)
    first.say(Inputs(table.tick_number + 1, 0, EAST))
    second = table.join()
    place = table.game.world.position(second.session.entity)
    table.tick(3)
    assert table.game.world.position(second.session.entity) == place
    assert len(table.game.world) == 1


def test_a_held_key_goes_on_after_a_wall_is_gone() -> None:
    table = Table(fill=[*FLOOR, [18, 0, 1, 19, 32, 4, 1]])
    link = table.join()
    tick = table.tick_number
    link.say(Inputs(tick + 1, 0, EAST * 60))
    table.tick(50)
    assert table.game.world.velocity(1)[0] == 0
    table.game.world.fill((18, 0, 1), (19, 32, 4), 0)
    table.tick()
    assert table.game.world.velocity(1)[0] > 0


def test_a_teleport_across_segments_reaches_clients_that_see_either_end() -> None:
    table = Table(fill=WIDE, size=(4, 1, 1), spawns=((10.0, 16.0, 1.0), (120.0, 16.0, 1.0), (14.0, 16.0, 1.0)))
    links = [table.join() for _ in range(3)]
    west, east = sorted(links[:2], key=lambda link: table.game.world.position(link.session.entity)[0])
    traveller = links[2]
    table.tick()
    assert traveller.session.entity not in ids(east.got(Snapshot)[-1])
    table.game.world.place(traveller.session.entity, (110.0, 16.0, 1.0))
    table.tick()
    assert traveller.session.entity in gone(west.got(Snapshot)[-1])
    assert traveller.session.entity in ids(east.got(Snapshot)[-1])


def test_a_player_that_falls_out_of_the_world_returns(table: Table) -> None:
    link = table.join()
    table.game.world.place(link.session.entity, (16.0, 16.0, -3.0))
    table.tick(3)
    assert table.game.world.position(link.session.entity)[2] >= 1.0
    assert table.game.counters.fell_out > 0


def test_a_sleeper_is_sent_to_clients_that_join_later(table: Table) -> None:
    first = table.join()
    table.tick(100)
    assert not table.game.world.awake(first.session.entity)
    second = table.connect(HELLO)
    table.tick()
    assert first.session.entity in ids(second.got(Snapshot)[0])


def test_a_state_with_a_template_that_does_not_exist_is_refused(table: Table) -> None:
    link = table.join()
    table.tick()
    snapshot = link.got(Snapshot)[0]
    rows = bytearray(snapshot.segments[0][5])
    rows[4] = 200
    part = list(snapshot.segments[0])
    part[5] = bytes(rows)
    with pytest.raises(ProtocolError, match="out of range"):
        decode_parts([part], len(table.game.scene.templates))
