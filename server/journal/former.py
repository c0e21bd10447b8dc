"""The hash of a world in recordings and saved worlds of formats 1 and 2: for reading them, and for nothing else.

It goes by an exclusive-or over the blocks of a segment, which some 40 chosen edits leave unchanged. So nothing new is
written with it. It has 16 bytes, and its successor has 20: the length tells which one a file holds.
"""

import hashlib
import struct

import numpy as np

from shared.blocks import Kinds
from shared.layout import Int64s
from shared.world import World

HASH_BYTES = 16


def digest_of(kinds: Kinds) -> int:
    """The former digest of one segment ([32768] kinds)."""
    at = np.flatnonzero(kinds).astype(np.uint64)
    value = (at + np.uint64(1)) << np.uint64(8) | kinds[at].astype(np.uint64)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return int(np.bitwise_xor.reduce(value ^ (value >> np.uint64(31)))) if len(at) else 0


def hash_of(tick: int, segments: Int64s, kinds: list[Kinds], states: Int64s) -> bytes:
    """The former hash of a world from its parts: segments [n, 3] and their blocks in any order, states [m, 12]."""
    order = np.lexsort((segments[:, 2], segments[:, 1], segments[:, 0]))
    blocks = np.empty((len(order), 4), "<i8")
    blocks[:, :3] = segments[order]
    blocks[:, 3] = np.array([digest_of(kinds[i]) for i in order], np.uint64).view(np.int64)
    digest = hashlib.blake2b(struct.pack("<q", tick), digest_size=HASH_BYTES)
    digest.update(blocks.tobytes())
    digest.update(states.astype("<i8").tobytes())
    return digest.digest()


def state_hash(world: World) -> bytes:
    """The former hash of a world."""
    rows = list(world.blocks.rows.values())
    return hash_of(world.tick, world.blocks.segments[rows], [world.blocks.kinds[row] for row in rows], world.states())
