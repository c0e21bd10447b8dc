"""The checkpoint of a replica: its world and its state as bytes, with which a new edge or standby begins."""

from typing import Any

import msgpack

from server.journal.recorded_world import RecordedWorld, packed
from server.persistence import checkpoint
from server.persistence.checkpoint import Checkpoint
from server.players import persisted_state
from server.scale.replica import Replica

FORMAT = 2
"""Version of the format."""


def encoded(replica: Replica, last: str) -> bytes:
    """Returns the checkpoint of a replica.

    Args:
        replica: the replica.
        last: id of the newest record in it (`server.scale.writer`).
    """
    world = replica.world
    segments = [(*cell, packed(world, cell)) for cell in sorted(world.blocks)]
    states = world.states().astype("<i8").tobytes()
    data: bytes = msgpack.packb(
        [
            FORMAT,
            last,
            [world.tick, world.next_id, states, world.state_hash(), segments],
            persisted_state.whole(replica.kept),
            [replica.epoch, replica.batches, replica.events],
            [[entity, *home] for entity, home in replica.homes.items()],
            [[*key, entity] for key, entity in replica.beside.items()],
            replica.edges,
        ]
    )
    return data


def decoded(data: bytes, fresh: RecordedWorld) -> tuple[Replica, str]:
    """Returns the replica of a checkpoint, and the id of the newest record in it.

    Args:
        data: result of `encoded`.
        fresh: a new world of the scene with its terrain.

    Raises:
        ValueError: the checkpoint cannot be used.
    """
    parts: list[Any] = msgpack.unpackb(data, strict_map_key=False)
    if parts[0] != FORMAT:
        raise ValueError(f"the checkpoint has format {parts[0]}, and this program reads format {FORMAT}")
    last, world, notes, known, homes, beside, edges = parts[1:]
    tick, next_id, states, hashed, segments = world
    saved = Checkpoint(tick, next_id, states, hashed, b"", [(x, y, z, kinds) for x, y, z, kinds in segments], [])
    replica = Replica(
        checkpoint.restored(fresh.scene, saved, compiled=fresh.compiled, terrain=fresh), persisted_state.restored(notes)
    )
    replica.epoch, replica.batches, replica.events = known
    replica.homes = {entity: (edge, client) for entity, edge, client in homes}
    replica.beside = {(edge, client): entity for edge, client, entity in beside}
    replica.edges = edges
    return replica, last
