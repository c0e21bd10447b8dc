"""Terrain that worlds share until they change it."""

import contextlib
import dataclasses
import gc
import mmap
import random
import sys
from pathlib import Path

import numpy as np
import pytest

from server.game import Game
from server.journal import recorded_world
from server.journal.recorded_world import RecordedWorld
from server.persistence.store import Store
from server.runtime.terrain import TerrainPool
from shared.blocks import BLOCKS
from shared.inputs import Input
from shared.scene import Scene, Template, load_scene
from shared.world import OverlapError, World

SCENES = ("arena", "flat", "meadow", "topdown")


def generated(scene: Scene) -> RecordedWorld:
    """Returns a world with its terrain in memory of its own."""
    world = RecordedWorld(scene)
    world.load_terrain()
    return world


def churn(world: World, seed: int, ticks: int = 30) -> list[bytes]:
    """Plays a world by a seed: a player walks, blocks change, a segment comes and goes. Returns each tick's hash."""
    r = random.Random(seed)
    scene = world.scene
    spans = [range(32 * at, 32 * (at + n)) for at, n in zip(scene.origin, scene.size, strict=True)]
    player = world.spawn(scene.player, scene.spawns[0], push=True)
    far = (scene.origin[0] - 3, 0, scene.origin[2])
    hashes = []
    for tick in range(ticks):
        for _ in range(3):
            with contextlib.suppress(OverlapError):
                x, y, z = map(r.choice, spans)
                world.set_block(x, y, z, r.randrange(5), push=True)
        if tick == ticks // 3:
            world.load_segment(far, np.full(BLOCKS, 3, np.uint8))
        if tick == ticks // 2:
            world.unload_segment(far)
        world.step({player: Input(r.randint(-127, 127), r.randint(-127, 127), 0)})
        hashes.append(world.state_hash())
    return hashes


def hashes(world: World) -> tuple[bytes, list[bytes]]:
    """Returns the hash of a world, and what is in its blocks now."""
    return world.state_hash(), [world.blocks.segment(cell).tobytes() for cell in sorted(world.blocks)]


@pytest.mark.parametrize("name", SCENES)
def test_a_shared_world_computes_the_same_bits_and_changes_no_other(name: str) -> None:
    scene, pool = load_scene(name), TerrainPool()
    untouched = hashes(generated(scene))
    idle, one, other = (pool.world(scene) for _ in range(3))
    assert hashes(idle) == untouched
    assert churn(one, 1) == churn(generated(scene), 1)
    assert churn(other, 2) == churn(generated(scene), 2)
    assert hashes(idle) == hashes(pool.of(scene)) == hashes(pool.world(scene)) == untouched


def test_a_shared_world_can_become_another_and_be_copied() -> None:
    scene, pool = load_scene("arena"), TerrainPool()
    one, other, own = pool.world(scene), pool.world(scene), generated(scene)
    churn(one, 3)
    churn(own, 4)
    before = hashes(one)
    copy = one.copy()
    assert hashes(copy) == before
    one.restore(own)
    assert hashes(one) == hashes(own)
    one.restore(other)
    assert hashes(one) == hashes(other) == hashes(generated(scene))
    assert hashes(copy) == before


def test_scenes_with_the_same_terrain_share_it(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[World] = []
    load_terrain = World.load_terrain

    def counted(self: World) -> None:
        made.append(self)
        load_terrain(self)

    monkeypatch.setattr(World, "load_terrain", counted)
    scene, pool = load_scene("arena"), TerrainPool()
    more = dataclasses.replace(scene, templates=(*scene.templates, Template("more", (0, 0, 0), (1, 1, 1))))
    assert pool.of(scene) is pool.of(load_scene("arena"))
    assert pool.of(more).scene is more
    assert len(made) == 1
    assert hashes(pool.world(more)) == hashes(pool.world(scene))
    pool.of(load_scene("flat"))
    assert len(made) == 2


def test_shared_terrain_cannot_be_changed_by_mistake() -> None:
    pool, scene = TerrainPool(), load_scene("arena")
    with pytest.raises(ValueError, match="read-only"):
        pool.of(scene).set_block(0, 0, -1, 0)


def test_a_world_takes_memory_only_where_it_is_changed() -> None:
    if sys.platform != "linux":
        pytest.skip("reads /proc")
    scene, pool = load_scene("flat"), TerrainPool()
    worlds = [pool.world(scene) for _ in range(4)]
    terrain_bytes = worlds[0].blocks.kinds.nbytes
    assert terrain_bytes > 500_000
    assert [_private_bytes(world) for world in worlds] == [0, 0, 0, 0]
    worlds[1].set_block(3, 3, 7, 2)
    assert [_private_bytes(world) for world in worlds] == [
        0,
        2 * mmap.PAGESIZE,
        0,
        0,
    ]  # one page of kinds, one of solid blocks


def _private_bytes(world: World) -> int:
    """Returns the bytes of the terrain that only this world has, from the system's list of mappings."""
    begin = world.blocks.kinds.__array_interface__["data"][0]
    lines = Path("/proc/self/smaps").read_text().splitlines()
    at = next(n for n, line in enumerate(lines) if line.startswith((f"{begin:x}-", f"{begin:08x}-")))
    found = next(line for line in lines[at:] if line.startswith("Anonymous:"))
    return int(found.split()[1]) * 1024


def test_worlds_that_end_leave_nothing_behind() -> None:
    scene, pool = load_scene("arena"), TerrainPool()
    Game(scene, world=pool.world(scene))
    gc.collect()
    before = _mappings(), _descriptors()
    games = [Game(scene, world=pool.world(scene)) for _ in range(5)]
    assert not Path("/proc/self/maps").exists() or _mappings() > before[0]
    del games
    gc.collect()
    assert (_mappings(), _descriptors()) == before


def _mappings() -> int:
    path = Path("/proc/self/maps")
    return path.read_text().count("memfd:terrain") if path.exists() else 0


def _descriptors() -> int:
    path = Path("/proc/self/fd")
    return sum(1 for _ in path.iterdir()) if path.exists() else 0


def test_a_saved_world_shares_its_terrain_and_is_restored_with_its_changes(tmp_path: Path) -> None:
    scene, pool = load_scene("arena"), TerrainPool()
    store = Store(tmp_path, scene, terrain=pool.of(scene))
    assert store.world.blocks.kinds.base is not None
    store.start(lambda: None)
    churn(store.world, 5)
    store.world.unload_segment((1, 1, 0))
    store.world.step()
    expected = hashes(store.world)
    assert store.close()
    for base in (pool.of(scene), None):
        again = Store(tmp_path, scene, terrain=base)
        assert hashes(again.world) == expected
        assert again.close()
    assert hashes(pool.world(scene)) == hashes(generated(scene))


def test_segments_known_to_be_as_generated_are_not_generated_to_compare_them(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("arena")
    world = TerrainPool().world(scene)
    cell, kind = (0, 0, -1), world.block(1, 1, -1)
    assert kind
    world.set_block(1, 1, -1, 0)
    assert recorded_world.packed(world, cell) is not None
    world.set_block(1, 1, -1, kind)
    assert recorded_world.packed(world, cell) is None
    calls: list[object] = []
    monkeypatch.setattr("shared.terrain.generate", lambda *args: calls.append(args))
    assert recorded_world.packed(world, (1, 1, -1)) is None
    assert not calls


def test_other_systems_use_a_file_without_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "other")
    scene, pool = load_scene("arena"), TerrainPool()
    world = pool.world(scene)
    assert churn(world, 6) == churn(generated(scene), 6)
    assert hashes(pool.world(scene)) == hashes(generated(scene))
