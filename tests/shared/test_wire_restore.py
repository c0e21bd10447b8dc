"""H31: a world that is restored from its wire bytes goes on like the original."""

import random

import msgpack
import pytest

from shared.blocks import pack, unpack
from shared.inputs import Input
from shared.scene import load_scene
from shared.snapshot import checksum, decode_parts, encode_part
from shared.world import World
from tests.lengths import long


def wired(world: World) -> World:
    """Returns another world, made only from the bytes of a snapshot and its terrain."""
    other = World(world.scene, compiled=world.compiled)
    segments = []
    for segment in world.blocks:
        other.load_segment(segment, unpack(pack(world.blocks.segment(segment).reshape(-1))))
        part = encode_part(segment, -1, world.in_segment(segment), check=checksum(world, segment))
        segments.append(msgpack.unpackb(part))
    parts, states, _ = decode_parts(segments, len(world.scene.templates))
    other.put(states)
    other.rebase(world.tick)
    assert [checksum(other, part.segment) for part in parts] == [part.check for part in parts]
    return other


@pytest.mark.parametrize("scene", ["arena", *long("flat", "topdown")])
def test_replaying_the_inputs_from_wire_bytes_gives_the_same_hash(scene: str, compiled: bool) -> None:
    world, rng = World(load_scene(scene), compiled=compiled), random.Random(31)
    world.load_terrain()
    players = [world.spawn("player", spawn) for spawn in world.scene.spawns]
    other = wired(world)
    for tick in range(600):
        wishes = {
            player: Input(rng.randint(-90, 90), rng.randint(-90, 90), rng.randint(0, 1))
            for player in players
            if rng.random() < 0.1
        }
        if tick % 50 == 0:
            other = wired(world)
        world.step(wishes)
        other.step(wishes)
        assert world.state_hash() == other.state_hash(), tick
