"""The former hash of a world, which is needed to read recordings and saved worlds of formats 1 and 2.

It uses an exclusive-or over the blocks of a segment. About 40 chosen edits can leave that unchanged, so nothing new is
written with this hash. It has 16 bytes and its successor 20; the length tells which one a file has.
"""

import hashlib
import struct

import numpy as np

from shared.blocks import Kinds
from shared.layout import Int64s
from shared.world import World

HASH_BYTES = 16
"""Length of the former hash in bytes."""


def digest_of(kinds: Kinds) -> int:
    """Returns the former digest of one segment ([32768] kinds)."""
    at = np.flatnonzero(kinds).astype(np.uint64)
    value = (at + np.uint64(1)) << np.uint64(8) | kinds[at].astype(np.uint64)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return int(np.bitwise_xor.reduce(value ^ (value >> np.uint64(31)))) if len(at) else 0


def hash_of(tick: int, segments: Int64s, kinds: list[Kinds], states: Int64s) -> bytes:
    """Returns the former hash of a world from its parts.

    Args:
        tick: the tick of the world.
        segments: indices of the segments in any order, [n, 3].
        kinds: blocks of the segments, in the same order.
        states: states of all entities, [m, 12].
    """
    order = np.lexsort((segments[:, 2], segments[:, 1], segments[:, 0]))
    blocks = np.empty((len(order), 4), "<i8")
    blocks[:, :3] = segments[order]
    blocks[:, 3] = np.array([digest_of(kinds[i]) for i in order], np.uint64).view(np.int64)
    digest = hashlib.blake2b(struct.pack("<q", tick), digest_size=HASH_BYTES)
    digest.update(blocks.tobytes())
    digest.update(states.astype("<i8").tobytes())
    return digest.digest()


def state_hash(world: World) -> bytes:
    """Returns the former hash of a world."""
    rows = list(world.blocks.rows.values())
    return hash_of(world.tick, world.blocks.segments[rows], [world.blocks.kinds[row] for row in rows], world.states())
