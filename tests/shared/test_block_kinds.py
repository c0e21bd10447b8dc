"""Kinds of blocks with a name: those that are not solid stop and support nothing, and block no place."""

import itertools
import random
from typing import Any

import numpy as np
import pytest

from shared import edits
from shared.block_kind import BlockKind
from shared.checks import SceneError
from shared.inputs import Input, clamp
from shared.layout import VX, X
from shared.messages import DONE, OVERLAPS
from shared.scene import SCENES, Scene, load_scene
from shared.world import OverlapError, World
from tests.worlds import EAST, build, floor, settle, steps

STONE, WATER, LADDER = 1, 5, 200
KINDS = (
    BlockKind("stone", STONE),
    BlockKind("water", WATER, solid=False),
    BlockKind("ladder", LADDER, solid=False),
)


def pool(*, compiled: bool, fill: Any = (), **changes: Any) -> World:
    """A world with a floor, and with water and stone by name."""
    return build([floor(), *fill], compiled=compiled, kinds=KINDS, **changes)


# -- the scene -----------------------------------------------------------------------------------------------


def test_scenes_without_kinds_keep_their_bytes() -> None:
    for file in SCENES.glob("*.toml"):
        scene = load_scene(file.stem)
        assert "kinds" not in scene.to_table()
        assert scene.passable == ()


def test_a_number_follows_that_of_the_kind_before() -> None:
    kinds = (BlockKind("a"), BlockKind("b"), BlockKind("c", 9), BlockKind("d"), BlockKind("e", 4))
    scene = Scene("test", kinds=kinds)
    assert [scene.kind(name) for name in "abcde"] == [1, 2, 9, 10, 4]
    assert scene.with_kind("f", solid=False).kind("f") == 5
    assert scene.with_kind("f", solid=False).passable == (5,)


def test_a_scene_with_kinds_survives_a_round_trip_and_has_its_own_fingerprint() -> None:
    made = Scene("test", kinds=KINDS)
    again = Scene.from_table(made.to_table())
    assert again == made
    assert again.fingerprint == made.fingerprint != Scene("test").fingerprint
    assert again.passable == (WATER, LADDER)
    dry = Scene("test", kinds=(KINDS[0], BlockKind("water", WATER), KINDS[2]))
    assert dry.digests["kinds"] != made.digests["kinds"]


def test_names_in_a_file(tmp_path: Any) -> None:
    file = tmp_path / "pool.toml"
    file.write_text(
        """
        size = [1, 1, 1]
        spawns = [[4, 4, 1]]
        [terrain]
        generator = "boxes"
        fill = [[0, 0, 0, 32, 32, 1, 1], [2, 2, 1, 9, 9, 4, "water"], [0, 0, 1, 1, 1, 2, "brick"]]
        [[kinds]]
        name = "water"
        number = 7
        solid = false
        [[kinds]]
        name = "brick"
        """
    )
    world = World(load_scene(file), compiled=False)
    world.load_terrain()
    assert world.block(3, 3, 3) == 7
    assert world.block(0, 0, 1) == 8
    entity = world.spawn("player", (4, 4, 3))
    settle(world)
    assert world.position(entity) == (4, 4, 1)


@pytest.mark.parametrize(
    ("kinds", "match"),
    [
        ((3,), r"^kinds\[0\] = 3: must be a `BlockKind`"),
        ("water", r"^kinds"),
        (None, r"^kinds"),
        ((BlockKind("a"), BlockKind("a")), r"^kinds\[1\]: 'a' has the name or the number 2"),
        ((BlockKind("a", 3), BlockKind("b", 3)), r"^kinds\[1\]: 'b' has the name or the number 3"),
        ((BlockKind("a", 255), BlockKind("b")), r"^kinds\.b\.number = 256"),
    ],
)
def test_kinds_that_cannot_be_are_refused(kinds: Any, match: str) -> None:
    with pytest.raises(SceneError, match=match):
        Scene("test", kinds=kinds)


@pytest.mark.parametrize(
    ("entry", "match"),
    [
        ({"name": ""}, r"^kinds\.name"),
        ({}, r"^kinds\.name: missing"),
        ({"name": "a", "number": 0}, r"^kinds\.a\.number = 0"),
        ({"name": "a", "number": 256}, r"^kinds\.a\.number = 256"),
        ({"name": "a", "number": 1.0}, r"^kinds\.a\.number"),
        ({"name": "a", "number": True}, r"^kinds\.a\.number"),
        ({"name": "a", "solid": 0}, r"^kinds\.a\.solid"),
        ({"name": "a", "hard": True}, r"^kinds\.hard: no such field"),
        (3, r"^kinds: 3 must be a table"),
    ],
)
def test_an_entry_of_a_table_that_cannot_be_is_refused(entry: Any, match: str) -> None:
    with pytest.raises(SceneError, match=match):
        Scene.from_table({"name": "test", "kinds": [entry]})


def test_an_unknown_kind_is_named() -> None:
    with pytest.raises(SceneError, match=r"^kind = 'lava': no such kind \(there are stone, water, ladder\)"):
        Scene("test", kinds=KINDS).kind("lava")
    with pytest.raises(SceneError, match=r"^terrain\.fill = 'lava': no such kind"):
        Scene("test", kinds=KINDS, terrain={"generator": "boxes", "fill": [[0, 0, 0, 1, 1, 1, "lava"]]})


# -- the world -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_a_world_with_water_moves_as_the_same_world_without(seed: int, compiled: bool) -> None:
    """Water and ladders everywhere, loaded, placed, filled, written and taken away: no entity notices."""
    rng = random.Random(seed)
    kinds = np.random.default_rng(seed).choice([0, 0, 0, 0, 0, 0, STONE, WATER, WATER, LADDER], 32768)
    wet, dry = (build([floor()], compiled=compiled, kinds=KINDS, entity_collision=True) for _ in range(2))

    def without(kind: int) -> int:
        return 0 if kind in (WATER, LADDER) else kind

    for world in (wet, dry):
        world.load_segment((0, 0, 0), kinds if world is wet else np.where(kinds == STONE, STONE, 0))
    spots = [(rng.uniform(-9, 9), rng.uniform(-9, 9), rng.uniform(0, 9)) for _ in range(30)]
    for spot in spots:
        found = []
        for world in (wet, dry):
            try:
                found.append(world.spawn(rng.choice(["box"]), spot, push=True))
            except OverlapError:
                found.append(0)
        assert found[0] == found[1]
    for _ in range(120 if compiled else 50):
        x, y, z = rng.randint(-6, 9), rng.randint(-6, 9), rng.randint(-1, 9)
        kind, push, act = rng.choice((0, STONE, WATER, LADDER)), rng.random() < 0.5, rng.randrange(4)
        outcomes = []
        for world in (wet, dry):
            given = kind if world is wet else without(kind)
            try:
                if act == 0:
                    world.set_block(x, y, z, given, push=push)
                elif act == 1:
                    world.fill((x, y, z), (x + 2, y + 3, z + 1), given, push=push)
                elif act == 2 and given != STONE:
                    world.write_blocks((0, 0, 0), [abs(x * 7 + y) % 32768], [given])
                outcomes.append(True)
            except OverlapError:
                outcomes.append(False)
        assert outcomes[0] == outcomes[1]
        wishes = {
            entity: clamp(Input(rng.randint(-127, 127), rng.randint(-127, 127), rng.randint(0, 1)))
            for entity in range(1, 8)
            if entity in wet and rng.random() < 0.1
        }
        for world in (wet, dry):
            world.step(wishes)
        assert wet.states().tolist() == dry.states().tolist()
        if rng.random() < 0.05:
            wet = wet.copy()


def test_what_stood_on_a_block_falls_when_it_turns_to_water(compiled: bool) -> None:
    world = pool(compiled=compiled, fill=[[0, 0, 0, 4, 4, 3, STONE]])
    on_block, on_it = world.spawn("stone", (1, 1, 3)), world.spawn("stone", (1, 1, 4.75))
    settle(world)
    assert world.awake_count == 0
    world.fill((0, 0, 2), (4, 4, 3), WATER)
    settle(world)
    assert [world.position(entity)[2] for entity in (on_block, on_it)] == [2, 3.75]
    world.write_blocks((0, 0, 0), [1 << 10 | 1 << 5 | 1], [LADDER])
    assert world.awake_count == 1
    settle(world)
    assert world.position(on_block)[2] == 1 or world.position(on_block)[2] == 2
    world.load_segment((0, 0, 0), np.full(32768, WATER, np.uint8))
    settle(world)
    assert world.position(on_block)[2] == 0


def test_removing_water_wakes_nobody(compiled: bool) -> None:
    world = pool(compiled=compiled, fill=[[-4, -4, 0, 4, 4, 3, WATER]])
    world.spawn("stone", (0, 0, 0))
    settle(world)
    assert world.fill((-4, -4, 0), (4, 4, 3), 0) == 192
    assert world.fill((-4, -4, 0), (4, 4, 3), LADDER) == 192
    assert world.fill((-4, -4, 0), (4, 4, 3), WATER) == 192
    assert world.awake_count == 0


def test_water_may_be_placed_where_an_entity_is_and_stone_may_not(compiled: bool) -> None:
    world = pool(compiled=compiled)
    entity = world.spawn("box", (0.1, 0.1, 0))
    settle(world)
    assert world.set_block(0, 0, 0, WATER)
    assert world.block(0, 0, 0) == WATER
    with pytest.raises(OverlapError, match=f"entity {entity} is there"):
        world.set_block(0, 0, 0, STONE)
    assert world.set_block(0, 0, 0, LADDER)
    assert world.set_block(0, 0, 0, STONE, push=True)
    assert world.position(entity) != (0.1, 0.1, 0)


def test_the_verdict_on_an_edit_is_what_it_does(compiled: bool) -> None:
    for kind, before in itertools.product((0, STONE, WATER, LADDER, 77), (0, WATER, LADDER)):
        world = pool(compiled=compiled)
        entity = world.spawn("box", (0.1, 0.1, 0))
        world.set_block(0, 0, 0, before)
        edit = edits.Edit(0, 0, 0, kind)
        told = edits.verdict(world, entity, edit)
        assert told == edits.apply(world, entity, edit) == (OVERLAPS if kind in (STONE, 77) else DONE)


def test_water_is_a_free_place_for_spawns_teleports_and_boxes(compiled: bool) -> None:
    world = pool(compiled=compiled, fill=[[-9, -9, 0, 9, 9, 9, WATER]])
    entity = world.spawn("person", (0, 0, 1))
    assert list(world.spawn_many("box", [(3.0, 3.0, 2.0), (5.0, 3.0, 2.0)])) == [2, 3]
    world.place(entity, (-3, -3, 4))
    world.set_template(entity, "slab")
    assert world.position(entity) == (-3, -3, 4)
    settle(world)
    assert world.position(entity)[2] == 0


def test_a_walker_goes_through_a_wall_of_water_at_its_speed(compiled: bool) -> None:
    world = pool(compiled=compiled, fill=[[2, -9, 0, 6, 9, 4, WATER], [8, -9, 0, 9, 9, 4, STONE]])
    entity = world.spawn("box", (0, 0, 0))
    steps(world, 64, {entity: EAST})
    assert world.position(entity) == (3, 0, 0)
    steps(world, 200)
    assert world.state(entity)[X] == round((8 - 5 / 8) * (1 << 24))
    assert world.state(entity)[VX] == 0


def test_a_copy_and_a_restored_world_keep_what_is_solid(compiled: bool) -> None:
    world = pool(compiled=compiled, fill=[[0, 0, 0, 4, 4, 3, WATER]])
    other = world.copy()
    world.set_block(1, 1, 1, STONE)
    other.restore(world)
    for each in (world, other, world.copy()):
        with pytest.raises(OverlapError):
            each.spawn("box", (1.1, 1.1, 1))
        each.spawn("box", (2.2, 2.2, 0))
    assert world.state_hash() == other.state_hash()


def test_a_world_without_kinds_has_solid_blocks_only(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    for kind in range(1, 256):
        world.set_block(0, 0, 0, kind)
        with pytest.raises(OverlapError):
            world.spawn("box", (0.1, 0.1, 0.5))
