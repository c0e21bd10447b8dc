"""A look at SQLite's -wal file (sqlite.org/walformat.html), for what SQLite itself does not tell.

SQLite reads the frames of the file up to the first that does not check, and forgets the rest. It synchronises a
transaction before it begins the next one. So after a crash what does not check is at most one transaction. If another
one comes behind it, a byte has changed that was on disk.
"""

import struct
from pathlib import Path

import numpy as np

HEAD_BYTES, FRAME_HEAD_BYTES = 32, 24
MAGICS = (0x377F0682, 0x377F0683)
"""The first number of a file whose checks are over little-endian, or big-endian, words."""


def damage(database: Path) -> str:
    """Says what is wrong behind the frames that SQLite uses; empty if a crash may have left it so.

    Args:
        database: of which it is the -wal; a connection has to be reading it.
    """
    path, index = (database.with_name(database.name + end) for end in ("-wal", "-shm"))
    data = path.read_bytes() if path.exists() else b""
    if len(data) < HEAD_BYTES or not index.exists():
        return ""
    if not _head_checks(data[:HEAD_BYTES]):  # it is synchronised ahead of the first frame
        return f"the head of {path.name} does not match its check" if len(data) > HEAD_BYTES else ""
    size, used = FRAME_HEAD_BYTES + int.from_bytes(data[8:12]), _frames_used(index)
    frames = np.frombuffer(data, np.uint8)[HEAD_BYTES:]
    frames = frames[: len(frames) // size * size].reshape(-1, size)[used:]
    behind = frames[(frames[:, 8:16] == np.frombuffer(data[16:24], np.uint8)).all(axis=1)]
    commits = np.flatnonzero(behind[:, 4:8].any(axis=1))
    if len(commits) and commits[0] < len(behind) - 1:
        return f"frame {used + 1} of {path.name} does not match its check"
    return ""


def _frames_used(index: Path) -> int:
    """The number of frames that SQLite uses, from its own index of them."""
    with index.open("rb") as file:
        return int(struct.unpack("=I", file.read(20)[16:])[0])


def _head_checks(head: bytes) -> bool:
    magic = int.from_bytes(head[:4])
    if magic not in MAGICS:
        return False
    one = two = 0
    for at in range(0, 24, 8):
        a, b = struct.unpack(">II" if magic & 1 else "<II", head[at : at + 8])
        one = (one + a + two) & 0xFFFFFFFF
        two = (two + b + one) & 0xFFFFFFFF
    return (one, two) == struct.unpack(">II", head[24:32])
