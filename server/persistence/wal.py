"""A check of SQLite's -wal file (sqlite.org/walformat.html) for damage that SQLite itself does not report.

SQLite reads the frames of the file up to the first whose checksum is wrong, and ignores the rest. It synchronises a
transaction before it begins the next one. So a crash leaves at most one transaction with wrong checksums, at the end.
If another transaction follows it, a byte that was on disk has changed.
"""

import struct
from pathlib import Path

import numpy as np

HEAD_BYTES, FRAME_HEAD_BYTES = 32, 24
"""Sizes of the header of the file and of the header of a frame, in bytes."""
MAGICS = (0x377F0682, 0x377F0683)
"""First numbers of a file: its checksums are over little-endian words, or over big-endian words."""


def damage(database: Path) -> str:
    """Returns what is wrong behind the frames that SQLite uses; empty if a crash may have left the file like this.

    Args:
        database: the database to which the -wal file belongs. A connection must be reading it.
    """
    path, index = (database.with_name(database.name + end) for end in ("-wal", "-shm"))
    data = path.read_bytes() if path.exists() else b""
    if len(data) < HEAD_BYTES or not index.exists():
        return ""
    if not _head_checks(data[:HEAD_BYTES]):  # the header is synchronised before the first frame
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
    """Returns the number of frames that SQLite uses, from its index file."""
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
