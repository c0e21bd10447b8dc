"""Behaviours on the server: saved worlds, recordings, agents, failures, and what the clients are sent."""

import io
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from client_sdk.events import Announced, BehaviourFailed, Corrected, Left
from server.journal.recorded_world import RecordedWorld
from server.journal.records import DivergedError, Recording
from server.persistence.database import StoreError
from server.persistence.store import Store
from server.rules import Rules, RulesError
from shared.behaviours import Behaviour, BehaviourError, field
from shared.body import Body
from shared.inputs import Input
from shared.scene import Scene
from sovereign_netcode import replay as replaying
from sovereign_netcode.playtest import Link, Match
from tests.behaving import BUTTONS, CLASSES, Acrobat, Crate, Playground, Presser, Shot, scene
from tests.lengths import contained, long
from tests.server.test_store import crashed

FIRE = 1 << BUTTONS.index("fire")


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[..., Store]]:
    """A function that opens stores of the scene with behaviours."""
    found: list[Store] = []

    def open_one(directory: Path = tmp_path / "data", of: Scene | None = None, *, start: bool = True) -> Store:
        found.append(Store(directory, scene() if of is None else of, checkpoint_s=2.0))
        if start:
            found[-1].start(lambda: None)
        return found[-1]

    yield open_one
    for store in found:
        store.close()


def populate(world: RecordedWorld) -> list[int]:
    """Adds crates and two players. Returns the numbers of the players."""
    for place in Playground.crates:
        world.spawn("crate", place)
    return [world.spawn("player", (20.0 + 3 * k, 20.0, 3.0)) for k in range(2)]


class Play:
    """Two players who press buttons at random in a world."""

    def __init__(self, world: RecordedWorld, seed: int) -> None:
        self.rng, self.pressers = random.Random(seed), {entity: Presser() for entity in populate(world)}

    def step(self, world: RecordedWorld, ticks: int) -> list[bytes]:
        """Plays some ticks. Returns the hash after each."""
        hashes = []
        for _ in range(ticks):
            world.step({entity: presser.next(self.rng) for entity, presser in self.pressers.items()})
            hashes.append(world.state_hash())
        return hashes


@pytest.mark.parametrize(("lives", "ticks", "seed"), [*contained((3, 90, 1)), *long((40, 200, 2))])
def test_a_world_comes_back_after_crashes_and_stops_and_goes_on_alike(
    opened: Callable[..., Store], tmp_path: Path, lives: int, ticks: int, seed: int
) -> None:
    store = opened()
    play = Play(store.world, seed)
    for _ in range(lives):
        play.step(store.world, ticks + play.rng.randrange(70))
        copy = crashed(store, tmp_path)
        again = opened(copy, start=False)
        assert again.world.state_hash() == store.world.state_hash()
        assert again.world.next_id == store.world.next_id
        for entity in store.world.states()[:, 0].tolist():
            assert again.world.fields(entity) == store.world.fields(entity)
        rng, pressers = random.Random(5), [Presser() for _ in play.pressers]
        for _ in range(40):
            inputs = {entity: each.next(rng) for entity, each in zip(play.pressers, pressers, strict=True)}
            for world in (store.world, again.world):
                world.step(inputs)
            assert store.world.state_hash() == again.world.state_hash()
        shutil.rmtree(copy)
        last = store.world.state_hash()
        assert store.close()
        store = opened()
        assert store.world.state_hash() == last


@pytest.mark.parametrize(("ticks", "seed"), [*contained((200, 3)), *long((6_000, 4))])
def test_a_recording_replays_to_the_same_hash_at_every_tick_in_both_kernels(ticks: int, seed: int) -> None:
    world, file = RecordedWorld(scene()), io.BytesIO()
    world.load_terrain()
    world.record(file)
    hashes = Play(world, seed).step(world, ticks)
    world.end_recording()
    for compiled in (True, False):
        moments = Recording(io.BytesIO(file.getvalue()), compiled=compiled, behaviours=CLASSES)
        assert [moment.world.state_hash() for moment in moments if not moment.ended] == hashes


def test_a_replay_names_the_tick_in_which_only_a_field_differs() -> None:
    world, file = RecordedWorld(scene()), io.BytesIO()
    world.load_terrain()
    world.record(file)
    crate = world.spawn("crate", (15.5, 15.5, 2.0))
    for _ in range(100):
        world.step()
    played = Recording(io.BytesIO(file.getvalue()), behaviours=CLASSES)

    def replay() -> None:
        for moment in played:
            if moment.world.tick == 33:
                moment.world.set_field(crate, "turns", 99)

    with pytest.raises(DivergedError, match="the entities that changed") as caught:
        replay()
    assert 34 <= caught.value.tick < 64  # at the next turn of the crate, before the next hash of the whole world


def test_an_entity_of_a_reused_number_gets_its_recorded_input() -> None:
    """The rules give each shot of a player the same input; its number is used again at once."""
    world, file = RecordedWorld(scene((Solo, Target))), io.BytesIO()
    world.load_terrain()
    world.record(file)
    player = world.spawn("player", (30.0, 30.0, 2.0))
    for _ in range(20):
        inputs = {player: Input(0, 0, FIRE * (world.tick % 2))}
        if player + 1 in world:
            inputs[player + 1] = Input(64, 0)
        world.step(inputs)
    assert world.state(player + 1)[9] == 64
    for moment in Recording(io.BytesIO(file.getvalue()), behaviours=(Solo, Target)):
        assert moment.world.tick <= 20


class Solo(Behaviour):
    templates = ("player",)
    spawns = 1

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            x, y, z = me.position
            me.spawn("shot", (x, y, z + 5.0), dies_at=me.tick + 3)


class Target(Behaviour):
    templates = ("shot",)
    dies_at = field(bits=32)

    def turn(self, me: Body) -> None:
        me.wake(me.dies_at)
        if me.tick >= me.dies_at:
            me.remove()


def recorded(path: Path, rules: Rules) -> None:
    """Writes a recording of a match of two seconds."""
    with path.open("wb") as file:
        match = Match(scene(()), 1, rules=rules)
        match.game.world.record(file)
        match.join(lambda core, rng: Input(64, 0), Link())
        match.run(2)
        match.game.world.end_recording()


def test_the_replay_tool_needs_the_game_of_a_recording_with_behaviours(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "record"
    recorded(path, Playground())
    assert replaying.main([str(path)]) == 2
    assert "needs the class Acrobat" in (text := capsys.readouterr().err)
    assert "--game MODULE:CLASS" in text
    assert replaying.main([str(path), "--game", "tests.behaving:Playground"]) == 0
    assert "ticks as recorded" in capsys.readouterr().out
    assert replaying.main([str(path), "--game", "tests.behaving:Nothing"]) == 2
    assert "cannot be loaded" in capsys.readouterr().err
    with pytest.raises(BehaviourError, match="Acrobat"), path.open("rb") as file:
        Recording(file)


def recoded(digest: str = "0123456789abcdef") -> Scene:
    """Returns the scene as it would be if the code of `Crate` were another."""
    table = scene().to_table()
    table["behaviours"][2] = {**table["behaviours"][2], "digest": digest}
    return Scene.from_table(table)


def test_changed_code_is_taken_after_a_clean_stop_and_refused_while_a_log_needs_the_old(
    opened: Callable[..., Store], tmp_path: Path
) -> None:
    store = opened()
    Play(store.world, 1).step(store.world, 90)
    copy = crashed(store, tmp_path)
    with pytest.raises(StoreError, match=r"code of the behaviours Crate has changed.*former code.*stop that"):
        Store(copy, recoded())
    last = store.world.state_hash()
    assert store.close()
    with closing(Store(tmp_path / "data", recoded())) as other:
        assert other.world.state_hash() == last
    with closing(Store(tmp_path / "data", recoded())) as other:  # the new code is the saved one now
        assert other.world.state_hash() == last
    fewer = scene((Acrobat, Shot))
    with pytest.raises(StoreError, match="another scene"):
        Store(tmp_path / "data", fewer)
    renamed = type("Crate", (Crate,), {"turns": field(bits=39)})
    with pytest.raises(StoreError, match="another scene"):
        Store(tmp_path / "data", scene((Acrobat, Shot, renamed)))


class Fragile(Behaviour):
    templates = ("player",)
    n = field(bits=8)

    def turn(self, me: Body) -> None:
        me.n = (me.n + 1) & 0xFF
        if me.pressed("fire"):
            raise ValueError("boom")


class ServerOnly(Behaviour):
    """Fails where a variable of the server's process says so: what must never be, but does no harm."""

    templates = ("player",)
    n = field(bits=8)
    where: str = ""

    def turn(self, me: Body) -> None:
        me.n = (me.n + 1) & 0xFF
        if me.pressed("fire"):
            me.velocity = (0.0, 0.0, 6.0)
            if ServerOnly.where == "server":
                raise ValueError("boom")


def game(*codes: type[Behaviour]) -> Rules:
    """Returns rules with some behaviours."""
    return type("Game", (Rules,), {"behaviours": codes})()  # type: ignore[no-any-return]


def test_a_turn_that_fails_on_both_sides_is_told_once_per_tick_and_corrects_nobody() -> None:
    match = Match(scene(()), 1, rules=game(Fragile))
    player = match.join(lambda core, rng: Input(0, 0, FIRE * (rng.random() < 0.3)), Link(0.1, 0.02))
    other = match.join(lambda core, rng: Input(), Link())
    match.run_until(lambda: player.core.state == "playing", 5)

    def again() -> None:
        assert player.core.prediction is not None
        assert player.core.prediction.sync_test() is None

    match.on_tick.append(again)
    match.run(5)
    failed = [event for event in player.events if isinstance(event, BehaviourFailed)]
    assert len(failed) > 10
    assert len({event.tick for event in failed}) == len(failed)
    assert {(event.behaviour, event.entity) for event in failed} == {("Fragile", player.core.entity)}
    assert "boom" in failed[0].error
    assert 0 <= len(failed) - match.game.counters.rules_failed <= 5  # the latest are ahead of the server
    assert not [event for event in player.events if isinstance(event, Corrected)]
    assert not [event for event in other.events if isinstance(event, Corrected)]
    assert player.core.stats.divergences == other.core.stats.divergences == 0


def test_a_turn_that_fails_on_one_side_corrects_the_client_and_leaves_no_wrong_state() -> None:
    match = Match(scene(()), 1, rules=game(ServerOnly))
    policy = [Input()]
    player = match.join(lambda core, rng: policy[0], Link(0.1, 0.0))
    match.run_until(lambda: player.core.state == "playing", 5)
    match.run(1)
    step = match.game.world.step

    def on_server(inputs: dict[int, Input]) -> None:
        ServerOnly.where = "server"
        step(inputs)
        ServerOnly.where = ""

    match.game.world.step = on_server  # type: ignore[method-assign, assignment]
    for pressed in (Input(0, 0, FIRE), Input()):
        policy[0] = pressed
        match.run(1)
    match.run(1)
    assert match.game.counters.rules_failed == 1
    assert [event.cause for event in player.events if isinstance(event, Corrected)] == ["nondeterminism"]
    prediction = player.core.prediction
    assert prediction is not None
    assert prediction.predicted.velocity(player.core.entity) == (0.0, 0.0, 0.0)
    assert prediction.predicted.fields(player.core.entity) == prediction.confirmed.fields(player.core.entity)


class Leaves(Behaviour):
    """Removes its entity, which the rules have made of a player."""

    templates = ("crate",)

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            me.remove()


def test_a_player_whose_entity_a_behaviour_removes_leaves_and_the_game_goes_on() -> None:
    match = Match(scene(()), 1, rules=game(Leaves))
    player = match.join(lambda core, rng: Input(0, 0, FIRE * (rng.random() < 0.1)), Link())
    other = match.join(lambda core, rng: Input(), Link())
    match.run_until(lambda: player.core.state == other.core.state == "playing", 5)
    with match.game.api.turn:
        match.game.api.change(player.core.entity, "crate")
    match.run(4)
    assert [type(event) for event in player.events][-1] is Left
    assert "removed this player's entity" in str(player.events[-1])
    assert list(match.game.players) == [other.core.entity]
    assert other.core.state == "playing"


@pytest.mark.parametrize("behaviours", [None, Acrobat, (int,), (Acrobat, Acrobat), "Acrobat", (Acrobat(),)])
def test_rules_with_wrong_behaviours_are_refused_by_name(behaviours: object) -> None:
    rules = type("Game", (Rules,), {"behaviours": behaviours})()
    with pytest.raises(RulesError, match=r"Game\.behaviours"):
        Match(scene(()), 1, rules=rules)


class Dropper(Behaviour):
    templates = ("player",)
    spawns = 2

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            me.spawn("crate", (20.5, 20.5, 3.0))


def test_what_a_behaviour_has_spawned_is_removed_where_it_falls_out_and_others_are_put_back() -> None:
    match = Match(scene(()), 1, rules=game(Dropper))
    world = match.game.world
    presses = [FIRE]
    player = match.join(lambda core, rng: Input(0, 0, presses.pop() if presses else 0), Link())
    match.run_until(lambda: player.core.state == "playing", 20)
    world.fill((15, 15, 0), (26, 26, 2), 0)
    match.run_until(lambda: len(world) == 2, 5)
    with match.game.api.turn:
        other = match.game.api.spawn("crate", (23.0, 23.0, 3.0))
    match.run(4)
    assert match.game.counters.fell_out == 2
    assert sorted(world.states()[:, 0].tolist()) == [player.core.entity, other]
    assert world.position(other)[2] > 1
    assert int(world.states_of([player.core.entity])[0, 12 + world.extras.alive]) == 1 << 32


def test_agents_play_a_game_with_behaviours_alike_for_one_seed() -> None:
    agents = pytest.importorskip("server.agents")
    arena = agents.Arena(scene(()), agents=2, rules=Playground, seconds=3)
    hashes = []
    for _ in range(2):
        arena.reset(seed=5)
        pressers, rng = [Presser(), Presser()], random.Random(2)
        while arena.agents:
            arena.step({agent: presser.next(rng) for agent, presser in zip(arena.agents, pressers, strict=False)})
        hashes.append(arena.world.state_hash())
        assert arena.api.field(1, "turns") > 8  # a crate
        assert sum(arena.world.field(arena.entity(agent), "shots") for agent in arena.possible_agents) > 0
    assert hashes[0] == hashes[1]


def test_others_get_announcements_of_entities_that_they_see() -> None:
    match = Match(scene(()), 2, rules=Playground())
    players = [match.join(policy, Link(0.05, 0.0)) for policy in (Presser(), lambda core, rng: Input())]
    match.run(10)
    mine, theirs = ([event for event in each.events if isinstance(event, Announced)] for each in players)
    own = [(event.tick, event.entity, event.name, event.data) for event in mine if event.number]
    heard = [(event.tick, event.entity, event.name, event.data) for event in theirs if not event.number]
    assert len(own) > 10
    assert [event for event in heard if event not in own] == []
    assert 0 <= len(own) - len(heard) <= 4
