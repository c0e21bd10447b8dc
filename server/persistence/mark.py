"""The mark: a small file beside the database, `world.mark`, with the tick up to which a world has been saved.

SQLite opens a database whose -wal file is damaged without an error and ignores everything from the damage on. That is
right after a crash, which leaves an incomplete transaction. It is wrong if a byte of a complete transaction has
changed, or if the end of the file is missing. Only a note that was written after the transaction can tell these cases
apart.

The mark has the newest tick of the log and the chain there (`server.persistence.database`). It is written after each
transaction and before anything in it is acknowledged, without an fsync of its own. After the end of the process it is
complete. After a power cut it may be older than what SQLite had synchronised, but not newer. So a log that ends before
the mark has lost something that was promised. One exception: with `--durability process` SQLite does not synchronise,
so after a power cut the mark may be newer than the log. `boot` tells whether the machine was restarted since.

file   2 slots, 512 bytes apart, written in turn: a torn write spoils one of them
slot   8 bytes "SNWMARK1"   u64 number (the higher one is newer)   i64 tick   u32 chain   u8 power
       16 bytes boot   u32 CRC-32 of all these
"""

import contextlib
import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

MAGIC = b"SNWMARK1"
"""First bytes of a slot."""
SLOT = struct.Struct("<8sQqIB16s")
"""Format of a slot without its check."""
CHECK = struct.Struct("<I")
"""Format of the check of a slot."""
APART = 512
"""Bytes from one slot to the next: the size of a sector, which a disk writes as a whole."""
UNKNOWN = bytes(16)
"""Identifier of the boot if the system has none."""


class Mark(NamedTuple):
    """A mark: the log had reached `tick`, with this chain."""

    number: int
    tick: int
    chain: int
    power: bool
    boot: bytes

    @property
    def binding(self) -> bool:
        """Whether a log that ends before the mark is damaged. Otherwise a power cut may have removed its end."""
        return self.power or self.boot == boot() != UNKNOWN

    def against(self, end: int, chains: Mapping[int, int]) -> str:
        """Returns what is wrong with a log; empty if it agrees with the mark.

        Args:
            end: the newest tick of the log.
            chains: the chain of each tick of the log.
        """
        if self.tick > end:
            return f"it ends with tick {end}, and was promised to hold tick {self.tick}"
        if chains.get(self.tick, self.chain) != self.chain:
            return f"its tick {self.tick} is not the one that was promised"
        return ""


class MarkFile:
    """A mark that is open for writing. The first `write` creates the file.

    Args:
        path: the file.
        power: whether transactions are synchronised before the mark is written.

    Raises:
        OSError: the file cannot be written (also raised by `write`).
    """

    def __init__(self, path: Path, *, power: bool) -> None:
        self._path, self._power, self._boot = path, power, boot()
        self._file: int | None = None
        self._number = 0

    def write(self, tick: int, chain: int) -> None:
        """Writes that everything up to the end of `tick` is on disk."""
        if self._file is None:
            self._open(tick, chain)
            return
        self._number += 1
        data, at = self._note(tick, chain), self._number % 2 * APART
        if hasattr(os, "pwrite"):
            os.pwrite(self._file, data, at)
        else:  # Windows
            os.lseek(self._file, at, os.SEEK_SET)
            os.write(self._file, data)

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _note(self, tick: int, chain: int) -> bytes:
        note = SLOT.pack(MAGIC, self._number, tick, chain, self._power, self._boot)
        return note + CHECK.pack(zlib.crc32(note))

    def _open(self, tick: int, chain: int) -> None:
        """Creates the file with its first slot, under another name first, so that it is never empty."""
        before = None
        with contextlib.suppress(ValueError):
            before = read(self._path)
        self._number = 1 if before is None else before.number + 1
        new = self._path.with_name(self._path.name + "-new")
        with new.open("wb") as file:
            file.write(self._note(tick, chain).ljust(2 * APART, b"\0"))
            file.flush()
            os.fsync(file.fileno())
        new.replace(self._path)
        self._file = os.open(self._path, os.O_RDWR | getattr(os, "O_BINARY", 0))


def read(path: Path) -> Mark | None:
    """Returns the newest mark in a file; None if there is no file.

    Raises:
        ValueError: the file has no valid mark.
        OSError: the file cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    found = []
    for at in (0, APART):
        note, check = data[at : at + SLOT.size], data[at + SLOT.size : at + SLOT.size + CHECK.size]
        if note.startswith(MAGIC) and check == CHECK.pack(zlib.crc32(note)):
            _, number, tick, chain, power, boot_then = SLOT.unpack(note)
            found.append(Mark(number, tick, chain, bool(power), boot_then))
    if not found:
        raise ValueError("it holds no mark")
    return max(found)


def boot() -> bytes:
    """Returns the identifier of the system's latest start; `UNKNOWN` where the system has none."""
    try:
        return bytes.fromhex(Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip().replace("-", ""))
    except (OSError, ValueError):
        return UNKNOWN
