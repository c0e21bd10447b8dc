"""Extra columns on the wire: clients that join late, skip ticks or see little have the server's fields to the bit."""

import random
import time

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from client_sdk.events import Diverged
from server.game import Game
from server.rules import Rules
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.extras import Extras, Record
from shared.fields import ENTITY_MAX
from shared.inputs import Input
from shared.layout import CELL
from shared.messages import ProtocolError, Resync, encode
from shared.snapshot import decode_parts
from shared.world import OverlapError
from sovereign_netcode.playtest import Link, Match
from tests.behaving import BUTTONS, Playground, Presser, scene
from tests.lengths import examples, long_but
from tests.server.test_replication import Stalling

FIRE = 1 << BUTTONS.index("fire")
ROW = scene(
    origin=(-3, 0, 0), size=(7, 1, 1), spawns=((16.0, 16.0, 3.0),),
    terrain={"generator": "boxes", "fill": [[-96, 0, 0, 128, 32, 2, 1]]},
)  # fmt: skip


class Behaving(Stalling):
    """The game of `Stalling` with behaviours: fields, templates, attributes and ids change at random."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed, ROW)
        self.pressers: dict[int, Presser] = {}

    def tick(self) -> None:
        for entity in self.others:
            if entity in self.game.world:
                self.game.api.steered[entity] = self.pressers[entity].next(self.rng)
        self.now += 1 / self.game.scene.tick_rate
        self.game.tick(self.now, self.now)
        self.others = [entity for entity in self.others if entity in self.game.world]

    def place(self) -> tuple[float, float, float]:
        return self.rng.uniform(-95, 127), self.rng.uniform(1, 31), self.rng.choice([2.0, 2.0, 5.0])

    def stir(self) -> None:
        world, api, rng = self.game.world, self.game.api, self.rng
        every = world.states()[:, 0].tolist()
        entity = rng.choice(every)
        try:
            with api.turn:
                match rng.randrange(14):
                    case 0 if len(every) < 40:
                        made = api.spawn(rng.choice(["player", "player", "crate"]), self.place())
                        self.pressers[made] = Presser()
                        self.others.append(made)
                    case 1 if self.others:
                        api.remove(self.others.pop(rng.randrange(len(self.others))))
                    case 2:
                        api.place(entity, self.place())
                    case 3:
                        api.throw(entity, (rng.uniform(-20, 20), 0, rng.uniform(0, 9)))
                    case 4 | 5 | 6 if fields := world.fields(entity):
                        name = rng.choice([*fields])
                        _, declared = world.field_column(world.state(entity)[1], name)
                        api.set_field(entity, name, rng.choice([declared.low, declared.high, declared.start]))
                    case 7:
                        api.change(entity, rng.choice(["player", "tall", "crate", "barrel", "dashing"]))
                    case 8:
                        api.set(entity, "name", rng.randrange(1000))
                    case 9 if rng.random() < 0.3:
                        self.game.receive(self.session, encode(Resync()), self.now)
        except OverlapError:
            pass


@pytest.mark.parametrize("seed", long_but([0, 3], range(8)))
def test_a_client_equals_the_server_with_any_skips_and_any_interest(seed: int) -> None:
    recorded, checks = Behaving(seed), 0
    recorded.tick()
    for _ in range(300):
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
    assert checks > 50
    assert recorded.game.counters.snapshots_skipped > 40


def test_a_client_that_joins_late_and_one_that_comes_back_have_all_fields() -> None:
    match = Match(scene(()), 8, rules=Playground())
    match.join(Presser(), Link(0.05, 0.02))
    match.run(8)
    late = match.join(Presser(), Link(0.05, 0.02))
    match.run_until(lambda: late.core.state == "playing", 20)
    hashes: dict[int, bytes] = {}
    match.on_tick.append(lambda: hashes.update({match.game.world.tick: match.game.world.states().tobytes()}))
    match.run(3)
    prediction = late.core.prediction
    assert prediction is not None
    assert prediction.confirmed.states().tobytes() == hashes[prediction.confirmed.tick]
    late.core.reconnect.patience_s = 10.0
    late.disconnect()
    match.run_until(lambda: late.core.state == "playing", 20)
    match.run(3)
    prediction = late.core.prediction
    assert prediction is not None
    assert prediction.confirmed.states().tobytes() == hashes[prediction.confirmed.tick]
    assert not [event for event in late.events if isinstance(event, Diverged)]


def test_a_field_that_the_client_has_wrong_is_found_by_a_checksum_and_mended() -> None:
    rules = type("Game", (Playground,), {"behaviours": (Ticking,)})()
    match = Match(scene((Ticking,)), 8, rules=rules)
    player = match.join(lambda core, rng: Input(), Link(0.02, 0.0))
    match.run(3)
    prediction, crate = player.core.prediction, 1
    assert prediction is not None
    hidden = prediction.confirmed.extras.acts
    prediction.confirmed.write_fields([Record(crate, [(hidden, 5)])])
    match.run(4)
    found = [event for event in player.events if isinstance(event, Diverged)]
    assert [event.what for event in found] == ["segment (0, 0, 0) differs from the server's"]
    assert match.game.counters.resyncs == 1
    assert int(prediction.confirmed.states_of([crate])[0, CELL + hidden]) == 0


class Ticking(Behaviour):
    """Counts, so that nothing in its segment changes but a field."""

    templates = ("crate",)
    n = field(bits=32)

    def turn(self, me: Body) -> None:
        me.n += 1
        me.wake(me.tick + 1)


EXTRAS: Extras = scene().extras


@settings(max_examples=examples(500), deadline=None)
@given(st.binary(max_size=120))
def test_any_bytes_are_records_or_a_protocol_error(packed: bytes) -> None:
    try:
        records = EXTRAS.decode(packed)
    except ProtocolError:
        return
    assert b"".join(_packed(*record) for record in records) == packed


def _packed(entity: int, values: list[tuple[int, int]]) -> bytes:
    whole = [0] * EXTRAS.count
    for column, value in values:
        whole[column] = value
    return EXTRAS.record(entity, sum(1 << column for column, _ in values), whole)


@settings(max_examples=examples(300), deadline=None)
@given(st.integers(1, ENTITY_MAX), st.integers(0, (1 << EXTRAS.count) - 1), st.randoms(use_true_random=False))
def test_a_record_is_read_as_it_was_written(entity: int, mask: int, rng: random.Random) -> None:
    values = [rng.choice((each.low, each.high, rng.randint(each.low, each.high))) for each in EXTRAS.columns]
    packed = EXTRAS.record(entity, mask, values)
    (record,) = EXTRAS.decode(packed)
    assert record.entity == entity
    assert dict(record.values) == {k: value for k, value in enumerate(values) if mask >> k & 1}
    for cut in range(1, len(packed)):
        with pytest.raises(ProtocolError):
            EXTRAS.decode(packed[:cut])


def test_a_million_records_are_refused_or_read_in_linear_time() -> None:
    record = EXTRAS.record(5, 0, [0] * EXTRAS.count)
    start = time.process_time()
    assert len(EXTRAS.decode(record * 20_000)) == 20_000
    assert time.process_time() - start < 5


def test_rules_without_behaviours_have_no_extra_columns() -> None:
    assert scene(aim=False).extras.count == scene().extras.count - 3
    assert Match(scene((), aim=False), 1, rules=Rules()).game.world.extras.count == 0


class Reuses(Behaviour):
    templates = ("player",)
    spawns = 1

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            x, y, z = me.position
            me.spawn("crate", (x, y, z + 4.0))


def test_an_entity_of_a_reused_number_has_no_attributes_of_the_one_before() -> None:
    game = Game(scene((Reuses,)))
    with game.api.turn:
        player = game.api.spawn("player", (30.0, 30.0, 2.0))
    shot = player + 1

    def tick(buttons: int) -> None:
        game.api.steered[player] = Input(0, 0, buttons)
        game.tick(0.0, 0.0)

    tick(FIRE)
    with game.api.turn:
        game.api.set(shot, "name", "old")
    tick(0)
    since, segment = game.world.tick, game.log.segment(shot)
    with game.api.turn:
        game.api.remove(shot)
    tick(FIRE)
    assert shot in game.world
    tick(0)
    part = msgpack.unpackb(game.log.since(since)[segment], strict_map_key=False)
    (decoded,), _, _ = decode_parts([part], len(game.scene.templates))
    assert decoded.attributes == [(shot, {})]
    assert decoded.gone == []
