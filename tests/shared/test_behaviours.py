"""Behaviours in a world: the same bits in both kernels, in copies, after rollbacks, and whatever goes wrong."""

import importlib
import linecache
import random
import textwrap
from pathlib import Path
from typing import Any

import pytest

from shared.behaviours import Behaviour, BehaviourError, entry_of, field
from shared.body import Body
from shared.checks import SceneError
from shared.inputs import Input
from shared.scene import Scene
from shared.world import World
from tests.behaving import BUTTONS, Acrobat, Crate, Presser, Shot, populated, scene
from tests.lengths import contained, long
from tests.piling import piled, shuffled

FIRE = 1 << BUTTONS.index("fire")


def alone(code: type[Behaviour], *more: type[Behaviour], players: int = 1) -> tuple[World, list[int]]:
    """Returns a world with only these behaviours, and the players in it."""
    world = World(scene((code, *more)))
    world.load_terrain()
    return world, [world.spawn("player", (20.0 + 4 * k, 20.0, 2.0)) for k in range(players)]


def failures(world: World) -> list[str]:
    """Returns the texts of the failed turns since the last call."""
    assert world.turns is not None
    return [str(each.error) for each in world.turns.take_failures()]


@pytest.mark.parametrize(("players", "ticks", "seed"), [*contained((3, 250, 1)), *long((3, 4_000, 15), (30, 500, 13))])
def test_both_kernels_and_a_world_that_is_restored_have_the_same_hashes(players: int, ticks: int, seed: int) -> None:
    fast, ids = populated(players, compiled=True)
    plain, _ = populated(players, compiled=False)
    other, _ = populated(0, compiled=True)
    rng, names = random.Random(seed), set()
    pressers = {entity: Presser() for entity in ids}
    for tick in range(ticks):
        inputs = {entity: presser.next(rng) for entity, presser in pressers.items()}
        if tick % 50 == 49:
            other.restore(fast)
        for world in (fast, plain, other):
            if world is not other or tick >= 49:
                world.step(inputs)
        assert fast.state_hash() == plain.state_hash(), tick
        assert tick < 49 or fast.state_hash() == other.state_hash(), tick
        assert fast.turns is not None
        assert failures(fast) == []
        names |= {each.name for each in fast.turns.announced}
    assert names >= {"shot", "dash", "built"}
    if ticks > 250:
        assert names == {"shot", "dash", "built", "recall", "click", "hit", "bump"}


@pytest.mark.parametrize(("ticks", "seed"), [*contained((150, 4)), *long((6_000, 5))])
def test_eight_ticks_played_again_in_every_tick_change_nothing(ticks: int, seed: int) -> None:
    world, ids = populated(2)
    again = world.copy()
    kept, played = [world.copy() for _ in range(9)], []
    rng, pressers = random.Random(seed), [Presser() for _ in ids]
    for tick in range(ticks):
        inputs = {entity: presser.next(rng) for entity, presser in zip(ids, pressers, strict=True)}
        kept[tick % 9].restore(world)
        played.append(inputs)
        world.step(inputs)
        if tick >= 8:
            again.restore(kept[(tick - 7) % 9])
            for row in played[-8:]:
                again.step(row)
            assert again.tick == world.tick
            assert again.states().tobytes() == world.states().tobytes(), tick
            assert again.state_hash() == world.state_hash()


def test_a_copy_has_fields_and_goes_on_alike() -> None:
    world, (entity,) = populated(1)
    world.set_field(entity, "stamina", 11)
    copy = world.copy()
    assert copy.fields(entity) == world.fields(entity)
    for k in range(40):
        given = {entity: Input(0, 0, 2 * (k % 3 == 0))}
        world.step(given)
        copy.step(given)
        assert world.state_hash() == copy.state_hash()
    assert world.field(entity, "stamina") != 11


def test_fields_have_their_ranges_and_start_values() -> None:
    world, (entity,) = populated(1)
    start = {each.name: each.start for each in entry_of(Acrobat).fields}
    assert world.fields(entity) == start
    for each in entry_of(Acrobat).fields:
        for value in (each.low, each.high):
            world.set_field(entity, each.name, value)
            assert world.field(entity, each.name) == value
        for wrong in (each.low - 1, each.high + 1, 1.0, None, "1"):
            with pytest.raises(SceneError, match=each.name):
                world.set_field(entity, each.name, wrong)  # type: ignore[arg-type]
        world.set_field(entity, each.name, each.start)
    assert world.fields(entity) == start


class Spawner(Behaviour):
    templates = ("player", "crate")
    spawns = 2

    def turn(self, me: Body) -> None:
        x, y, z = me.position
        if me.pressed("fire") or me.template == "crate":
            me.spawn("crate", (x + 1.5, y, z + me.tick / 4))
            me.wake(me.tick + 1)


def test_what_a_spawned_entity_spawns_takes_no_ids_of_others() -> None:
    world, (first, second) = alone(Spawner, players=2)
    assert (first, second) == (1, 4)
    for k in range(20):
        world.step({first: Input(0, 0, FIRE * (k % 2)), second: Input()})
    assert world.states()[:, 0].tolist() == [1, 2, 3, 4]
    assert world.scene.templates[world.state(second)[1]].name == "player"
    assert "no numbers are reserved" in failures(world)[0]
    assert world.spawn("crate", (40.0, 40.0, 2.0)) == 7  # 5 and 6 belong to the second player


class Gun(Behaviour):
    templates = ("player",)
    spawns = 3
    got = field(bits=31)

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            x, y, z = me.position
            me.got = me.spawn("shot", (x, y, z + 1.0), (0.0, 0.0, 5.0)) or 0


def test_ids_are_used_in_turn_and_come_back_when_their_entity_is_gone() -> None:
    world, (entity,) = alone(Gun)
    got = []
    for k in range(24):
        world.step({entity: Input(0, 0, FIRE * (k % 2))})
        if k % 2:
            got.append(world.field(entity, "got"))
        if k in (11, 17):
            world.remove(got[1])
    assert got == [2, 3, 4, 0, 0, 0, 3, 0, 0, 3, 0, 0]
    assert sorted(world.states()[:, 0].tolist()) == [1, 2, 3, 4]


class Suicide(Behaviour):
    templates = ("player",)

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            me.velocity = (0.0, 0.0, 9.0)
            me.remove()


def test_a_player_does_not_remove_itself_and_the_turn_has_no_effect() -> None:
    world, (entity,) = alone(Suicide)
    world.step({entity: Input(0, 0, FIRE)})
    assert entity in world
    assert world.velocity(entity) == (0.0, 0.0, 0.0)
    assert "is a player's" in failures(world)[0]


class Breaks(Behaviour):
    templates = ("player",)
    spawns = 2
    n = field(bits=8)

    def turn(self, me: Body) -> None:
        if not me.pressed("fire"):
            me.n += 1
            return
        x, y, z = me.position
        me.n = 200
        me.velocity = (0.0, 0.0, 9.0)
        me.steer(1.0, 0.0)
        me.edit(int(x) + 2, int(y), int(z), 4)
        me.spawn("shot", (x, y, z + 1.0))
        me.announce("x")
        me.wake(me.tick + 1)
        me.become("tall")
        raise ValueError("boom")


def test_a_turn_that_fails_does_nothing_and_the_next_one_has_a_clean_start() -> None:
    world, (entity,) = alone(Breaks)
    world.step({entity: Input()})
    before = world.state(entity)
    world.step({entity: Input(0, 0, FIRE)})
    now = world.state(entity)
    assert now[:11] == before[:11]
    assert now[12:] == before[12:]
    assert len(world) == 1
    assert world.block(22, 20, 2) == 0
    assert world.turns is not None
    assert world.turns.announced == []
    assert failures(world) == ["boom"]
    world.step({entity: Input(64, 0, 0)})
    assert world.fields(entity) == {"n": 2}
    assert len(world) == 1
    assert failures(world) == []


class Fits(Behaviour):
    templates = ("player", "tall")

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            me.announce("fits", me.become("tall"))
        if me.released("fire"):
            me.become("player")


def test_a_bigger_box_needs_room() -> None:
    world, (entity,) = alone(Fits)
    fits = []
    for _ in range(2):
        world.step({entity: Input(0, 0, FIRE)})
        assert world.turns is not None
        fits += [each.payload for each in world.turns.announced]
        world.step({entity: Input()})
        world.step({entity: Input()})
        world.set_block(20, 20, 4, 4)
    assert fits == [b"\xc3", b"\xc2"]
    assert world.scene.templates[world.state(entity)[1]].name == "player"


class Sleeper(Behaviour):
    templates = ("crate",)
    n = field(bits=8)

    def turn(self, me: Body) -> None:
        me.n += 1
        if me.n < 3:
            me.wake(me.tick + 10)


@pytest.mark.parametrize("many", [1, 40])
def test_an_entity_that_rests_has_a_turn_only_when_it_asked_for_one(many: int) -> None:
    world = World(scene((Sleeper,)))
    world.load_terrain()
    crates = [world.spawn("crate", (15.5 + 1.5 * (k % 8), 4.5 + 1.5 * (k // 8), 2.0)) for k in range(many)]
    counts = []
    for _ in range(60):
        world.step()
        counts.append({world.field(crate, "n") for crate in crates})
    assert counts == [{1}] * 10 + [{2}] * 10 + [{3}] * 40


def wrong(**values: Any) -> type[Behaviour]:
    """Returns a class of a behaviour with these attributes."""
    return type("Wrong", (Behaviour,), {"templates": ("player",), "turn": lambda self, me: None, **values})


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (lambda: scene((int,)), "int"),  # type: ignore[arg-type]
        (lambda: scene(Acrobat), "list of subclasses"),  # type: ignore[arg-type]
        (lambda: scene(None), "list of subclasses"),  # type: ignore[arg-type]
        (lambda: scene((Acrobat, Acrobat)), "same name"),
        (lambda: scene((Acrobat, wrong())), "'player' has a behaviour already"),
        (lambda: scene((wrong(templates=("nobody",)),)), "nobody"),
        (lambda: scene((wrong(templates="player"),)), "must be a tuple"),
        (lambda: scene((wrong(templates=()),)), "at least one template"),
        (lambda: scene((wrong(templates=(1,)),)), "templates"),
        (lambda: scene((wrong(spawns=33),)), "spawns"),
        (lambda: scene((wrong(spawns="2"),)), "spawns"),
        (lambda: scene((type("Wrong", (Behaviour,), {"templates": ("player",)}),)), "no method `turn`"),
        (lambda: scene((wrong(**{f"n{k}": field(bits=1) for k in range(33)}),)), "33 fields"),
        (lambda: field(bits=0), "bits"),
        (lambda: field(bits=49), "bits"),
        (lambda: field(bits=True), "bits"),
        (lambda: field(bits=8, start=256), "start"),
        (lambda: field(bits=8, start=-1), "start"),
        (lambda: field(bits=8, start=1.0), "start"),  # type: ignore[arg-type]
        (lambda: field(bits=8, signed=1), "signed"),  # type: ignore[arg-type]
    ],
)
def test_wrong_classes_are_refused_with_the_field_and_the_value(made: Any, text: str) -> None:
    with pytest.raises(SceneError, match=text):
        made()


@pytest.mark.parametrize("name", ["id", "tick", "position", "spawn", "entry", "behaviour", "_values", "taken", "begin"])
def test_names_that_each_body_has_are_taken(name: str) -> None:
    with pytest.raises(SceneError, match=f"{name}.*taken"):
        scene((wrong(**{name: field(bits=8)}),))


def test_a_name_in_a_turn_that_is_no_field_is_an_error() -> None:
    class Typo(Behaviour):
        templates = ("player",)
        stamina = field(bits=8)

        def turn(self, me: Body) -> None:
            me.stanima = 3

    world, (entity,) = alone(Typo)
    world.step({entity: Input(64, 0)})
    assert "stanima" in failures(world)[0]


def test_classes_that_a_scene_needs_are_refused_by_name() -> None:
    told = Scene.from_table(scene().to_table())
    assert told.fingerprint == scene().fingerprint
    assert told.bound((Crate, Acrobat, Shot)).fingerprint == scene().fingerprint
    with pytest.raises(BehaviourError, match="needs the class Crate"):
        told.bound((Acrobat, Shot))
    other = type("Crate", (Crate,), {"turns": field(bits=39)})
    with pytest.raises(BehaviourError, match="Crate differs"):
        told.bound((Acrobat, Shot, other))
    unbound = World(told)
    unbound.load_terrain()
    with pytest.raises(SceneError, match="Acrobat, Shot, Crate"):
        unbound.step()


def made_by_exec(text: str) -> type[Behaviour]:
    """Returns a class without a file, as an interactive session makes it."""
    names: dict[str, Any] = {"Behaviour": Behaviour, "__name__": "nowhere"}
    exec(textwrap.dedent(text), names)
    found: type[Behaviour] = names["Made"]
    return found


def test_the_digest_of_a_class_without_a_file_depends_on_its_numbers_and_not_on_places() -> None:
    text = """
    class Made(Behaviour):
        templates = ("player",)
        def turn(self, me):
            me.velocity = tuple(part + 1.0 for part in me.velocity)
    """
    first, again = (entry_of(made_by_exec(each)).digest for each in (text, "\n\n" + textwrap.dedent(text)))
    other = entry_of(made_by_exec(text.replace("1.0", "2.0"))).digest
    inner = entry_of(made_by_exec(text.replace("part +", "part -"))).digest
    assert first == again
    assert len({first, other, inner}) == 3


def test_the_digest_is_of_the_code_that_runs_and_not_of_a_file_that_changes_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "changing_game.py"
    text = "from shared.behaviours import Behaviour\n\nclass Made(Behaviour):\n    templates = ('player',)\n"
    file.write_text(text + "    def turn(self, me):  # a comment\n        me.wake(1)\n")
    monkeypatch.syspath_prepend(tmp_path)
    made = importlib.import_module("changing_game").Made
    before = entry_of(made).digest
    file.write_text(text + "    def turn(self, me):\n        me.wake(2)\n")
    linecache.checkcache()
    assert entry_of(made).digest == before


@pytest.mark.parametrize(("seed", "ticks"), [*contained((1, 120)), *long(*((seed, 1_500) for seed in range(2, 8)))])
def test_boxes_and_blocks_put_into_each_other_have_one_result_in_any_order_of_the_inputs(seed: int, ticks: int) -> None:
    (fast, ids), (plain, _), (other, _) = (piled(6, compiled=compiled) for compiled in (True, False, True))
    rng, pressers, most = random.Random(seed), [Presser(5) for _ in range(6)], 0
    for tick in range(ticks):
        inputs = {entity: presser.next(rng) for entity, presser in zip(ids, pressers, strict=True)}
        if tick % 7 == 0:
            other.restore(fast)
        fast.step(inputs)
        plain.step({entity: inputs[entity] for entity in shuffled(rng, ids)})
        other.step({entity: inputs[entity] for entity in shuffled(rng, ids)})
        assert fast.state_hash() == plain.state_hash() == other.state_hash(), tick
        assert failures(fast) == []
        most = max(most, len(fast))
    assert most > 6
