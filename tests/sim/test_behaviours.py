"""Behaviours in a match: predicted in the next frame, confirmed to the bit, and corrected with a cause."""

import io
import random
from collections import Counter
from collections.abc import Sequence

import pytest

from client_sdk.core import Core
from client_sdk.events import Announced, BehaviourFailed, Corrected, Diverged, Withdrawn
from client_sdk.netsim.links import PRESETS
from server.journal.records import Recording
from server.rules import Rules
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.inputs import Input
from shared.units import BLOCK
from sovereign_netcode.playtest import Link, Match, Player, wander
from tests.behaving import BUTTONS, CLASSES, Playground, Presser, scene
from tests.lengths import contained, long
from tests.piling import Piles

DASH, FIRE = (1 << BUTTONS.index(name) for name in ("dash", "fire"))


def joined(rules: Rules, path: Link, *policies: object, seed: int = 3, neighbours: bool = True) -> Match:
    """Returns a match in which a player of each policy plays."""
    match = Match(scene(()), seed, rules=rules)
    for policy in policies:
        core = Core(behaviours=rules.behaviours, neighbours=neighbours)
        match.join(policy, path, core)  # type: ignore[arg-type]
    match.run_until(lambda: all(player.core.state == "playing" for player in match.players), 60)
    return match


def causes(players: Sequence[Player]) -> Counter[str]:
    """Returns the number of corrections of players by cause."""
    return Counter(event.cause for each in players for event in each.events if isinstance(event, Corrected))


def told(player: Player) -> Counter[str]:
    """Returns the number of announcements that a player got, by name, less those that were withdrawn."""
    count: Counter[str] = Counter()
    for event in player.events:
        if isinstance(event, Announced) and event.number:
            count[event.name] += 1
        elif isinstance(event, Withdrawn):
            count[event.name] -= 1
    return count


@pytest.mark.parametrize(
    ("preset", "ticks"),
    [*contained(("far", 200)), *long(*((preset, 2_500) for preset in PRESETS))],
)
def test_a_lone_player_with_every_ability_is_corrected_for_late_inputs_only(preset: str, ticks: int) -> None:
    match = joined(Playground(), PRESETS[preset], Presser(), seed=11)
    (player,) = match.players
    prediction = player.core.prediction
    assert prediction is not None
    file, hashes, announced = io.BytesIO(), [], Counter[str]()
    match.game.world.record(file)

    def check() -> None:
        assert prediction.sync_test() is None
        hashes.append(match.game.world.state_hash())
        turns = match.game.world.turns
        assert turns is not None
        announced.update(event.name for event in turns.announced if event.entity <= prediction.last_own)

    match.on_tick.append(check)
    before = told(player)
    match.run(ticks / 32)
    match.game.world.end_recording()
    assert set(causes([player])) <= {"late input"}
    assert not [event for event in player.events if isinstance(event, Diverged | BehaviourFailed)]
    assert player.core.stats.divergences == match.game.counters.rules_failed == 0
    if not player.core.stats.inputs_late + player.core.stats.inputs_substituted:
        assert not causes([player])
        missing = announced - (told(player) - before)
        assert sum(missing.values()) <= 3  # those of the latest ticks are not predicted or not confirmed yet
    for compiled in (True, False) if ticks < 1000 else (True,):
        moments = Recording(io.BytesIO(file.getvalue()), compiled=compiled, behaviours=CLASSES)
        assert [moment.world.state_hash() for moment in moments if not moment.ended] == hashes


class Once:
    """A policy that presses a button once."""

    def __init__(self, bits: int) -> None:
        self._bits, self.due = bits, False

    def __call__(self, core: Core, rng: random.Random) -> Input:
        pressed, self.due = self.due, False
        return Input(127, 0, self._bits if pressed else 0)


@pytest.mark.parametrize("latency_ms", [0, 300, *long(50, 150, 1000)])
def test_an_own_ability_shows_in_the_next_frame_and_a_shot_is_confirmed_under_its_id(latency_ms: int) -> None:
    policy = Once(DASH | FIRE)
    match = joined(Playground(), Link(latency_ms / 2000, 0.0), policy)
    (player,) = match.players
    core = player.core
    match.run(2)
    policy.due = True
    pressed = core.prediction.predicted.tick if core.prediction else 0
    match.run_until(lambda: not policy.due, 1)
    match.run_until(lambda: core.prediction.predicted.tick >= pressed + 2, 1)  # type: ignore[union-attr]
    view = core.view(player.local)
    shots = [each.entity for each in view.others if each.template == "shot"]
    assert view.me is not None
    assert view.me.template == "dashing"
    assert view.me.fields["stamina"] in (190, 195)  # it may have grown since
    assert len(shots) == 1
    assert core.entity < shots[0] <= core.entity + 3
    assert Counter(e.name for e in player.events if isinstance(e, Announced)) == {"dash": 1, "shot": 1}
    if latency_ms:
        assert shots[0] not in match.game.world
    match.run_until(lambda: shots[0] in match.game.world, 3)
    assert match.game.world.field(core.entity, "stamina") in (190, 195)
    match.run(latency_ms / 1000 + 0.2)
    there = shots[0] in [each.entity for each in core.view(player.local).others]
    assert there or latency_ms > 600  # a shot lives 0.6 s or longer
    match.run(3)
    assert shots[0] not in match.game.world
    assert [each.entity for each in core.view(player.local).others if each.template == "shot"] == []
    assert causes([player]) == {}
    assert Counter(e.name for e in player.events if isinstance(e, Announced)) == {"dash": 1, "shot": 1}
    assert not [event for event in player.events if isinstance(event, Withdrawn)]


class Costly(Behaviour):
    templates = ("player",)
    spawns = 2
    mana = field(bits=8, start=10)

    def turn(self, me: Body) -> None:
        if me.pressed("fire") and me.mana >= 10:
            me.mana -= 10
            x, y, z = me.position
            made = me.spawn("shot", (x, y, z + 1.0), (5.0, 0.0, 5.0))
            me.announce("cast", made)


class Poor(Rules):
    """Rules that take the mana away without a word to anybody: server and clients differ until the next snapshot."""

    behaviours = (Costly,)

    def on_tick(self) -> None:
        for entity in self.game.players:
            if self.game.field(entity, "mana") and self.game.tick > 60:
                self.game.set_field(entity, "mana", 0)


def test_a_shot_that_the_server_refuses_disappears_and_its_announcement_is_withdrawn() -> None:
    policy = Once(FIRE)
    match = joined(Poor(), Link(0.15, 0.0), policy)
    (player,) = match.players
    core, prediction = player.core, player.core.prediction
    assert prediction is not None
    match.run_until(lambda: match.game.world.tick == 58, 10)
    policy.due = True
    match.run_until(lambda: len(prediction.predicted) == 2, 1)
    shot = core.entity + 1
    assert shot in prediction.predicted
    match.run(3)
    assert shot not in prediction.predicted
    assert [each for each in core.view(player.local).others if each.template == "shot"] == []
    said = [event for event in player.events if isinstance(event, Announced)]
    gone = [event for event in player.events if isinstance(event, Withdrawn)]
    assert [(event.name, event.data) for event in said] == [("cast", shot)]
    assert [(event.number, event.name) for event in gone] == [(said[0].number, "cast")]
    assert causes([player]) == {"server act": 1}
    assert core.stats.divergences == 0
    assert len(match.game.world) == 1


class Crowd(Presser):
    """Presses buttons at random and runs to the middle of the scene."""

    def __call__(self, core: Core, rng: random.Random) -> Input:
        assert core.prediction is not None
        state = core.prediction.predicted.state(core.entity)
        input_ = self.next(rng)
        if rng.random() < 0.7:
            x, y = ((32 * BLOCK - part) // BLOCK for part in state[3:5])
            return input_._replace(move_x=max(-127, min(127, 30 * x)), move_y=max(-127, min(127, 30 * y)))
        return input_


@pytest.mark.parametrize(("players", "seconds", "seed"), [*contained((4, 4, 5)), *long((30, 2, 6), (8, 4, 7))])
def test_players_who_dash_into_each_other_are_corrected_for_each_other(players: int, seconds: int, seed: int) -> None:
    counts = {}
    for neighbours in (True, False):
        policies = [Crowd() for _ in range(players)]
        match = joined(Playground(), PRESETS["regional"], *policies, seed=seed, neighbours=neighbours)
        match.run(seconds)
        found = causes(match.players)
        assert set(found) <= {"other entity", "late input", "unknown edit"}
        assert not [e for each in match.players for e in each.events if isinstance(e, Diverged | BehaviourFailed)]
        assert all(each.core.stats.divergences == 0 for each in match.players)
        assert found["other entity"] > 0
        counts[neighbours] = found.total()
    assert counts[True] < counts[False]


@pytest.mark.parametrize(
    ("players", "seconds", "seed"), [*contained((3, 4, 1)), *long(*((6, 10, seed) for seed in range(2, 6)))]
)
def test_boxes_and_blocks_put_into_each_other_make_nobody_diverge(players: int, seconds: int, seed: int) -> None:
    match = joined(Piles(), PRESETS["regional"], *(Presser(6) for _ in range(players)), seed=seed)
    match.run(seconds)
    assert set(causes(match.players)) <= {"other entity", "late input", "unknown edit"}
    assert all(each.core.stats.divergences == 0 for each in match.players)
    assert match.game.counters.rules_failed == 0


class Idle(Behaviour):
    templates = ("player",)
    spawns = 4
    stamina = field(bits=8, start=100)

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            me.stamina -= 1


def test_an_ability_that_nobody_uses_costs_no_bytes_while_players_walk() -> None:
    counts = []
    for behaviours in ((), (Idle,)):
        rules = type("Game", (Rules,), {"behaviours": behaviours})()
        match = joined(rules, PRESETS["regional"], *[wander] * 3, seed=4)
        match.run(2)
        before = match.game.counters.snapshot_bytes
        match.run(8)
        counts.append(match.game.counters.snapshot_bytes - before)
    assert counts[0] > 1000
    assert counts[1] == counts[0]


@pytest.mark.parametrize(("preset", "seed"), [*contained(("thin", 5)), *long(*((preset, 6) for preset in PRESETS))])
def test_each_announcement_reaches_its_own_player_once(preset: str, seed: int) -> None:
    """Holds also where an input is late, so that the client predicts the announcement for another tick or not at all.

    The count leaves out the announcements of the last seconds, which may be on their way.
    """
    match = joined(Playground(), PRESETS[preset], *(Presser() for _ in range(4)), seed=seed)
    announced: list[tuple[int, int, str]] = []

    def note() -> None:
        turns = match.game.world.turns
        assert turns is not None
        announced.extend((match.game.world.tick, event.entity, event.name) for event in turns.announced)

    match.on_tick.append(note)
    first = match.game.world.tick
    match.run(8)
    last = match.game.world.tick
    match.run(5)
    for player in match.players:
        prediction = player.core.prediction
        assert prediction is not None
        own = range(player.core.entity, prediction.last_own + 1)
        made = Counter((entity, name) for tick, entity, name in announced if tick <= last and entity in own)
        withdrawn = {event.number for event in player.events if isinstance(event, Withdrawn)}
        got = [
            (event.entity, event.name, event.tick)
            for event in player.events
            if isinstance(event, Announced) and event.entity in own and event.number not in withdrawn
        ]
        later = Counter((entity, name) for entity, name, tick in got if tick > last)
        late = Counter((entity, name) for tick, entity, name in announced if tick > last and entity in own)
        found = Counter((entity, name) for entity, name, tick in got if first < tick <= last)
        assert len(made) > 1
        missing, extra = made - found - later, found - made - late
        assert (missing, extra) == (Counter(), Counter())
