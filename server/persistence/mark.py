"""A note of how much of a saved world has been acknowledged: `world.mark`, a small file beside the database.

SQLite opens a file whose -wal is damaged without a word: it takes what comes before the damage for all there is. That
is right after a crash, which leaves a transaction half written. It is wrong when a byte of a finished one has changed,
or the end of the file is gone. Only a note that was made after the transaction was on disk can tell the two apart.

The note names the newest tick of the log and the chain there (`server.persistence.database`). It is written after each
transaction and before anything in it is acknowledged, without an fsync of its own: after the end of the process it is
complete, and after a power cut it may be older, never newer, than what SQLite had synchronised. A log that ends before
the mark has lost something that was promised. One exception: with `--durability process` SQLite does not synchronise,
so after a power cut the mark may well be newer than the log. `boot` tells that the machine was started anew since.

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
SLOT = struct.Struct("<8sQqIB16s")
CHECK = struct.Struct("<I")
APART = 512
"""Bytes from one slot to the next: the size of a sector, which a disk writes whole."""
UNKNOWN = bytes(16)
"""Stands for the boot where the system does not tell."""


class Mark(NamedTuple):
    """One note: in the log, `tick` has this chain."""

    number: int
    tick: int
    chain: int
    power: bool
    boot: bytes

    @property
    def binding(self) -> bool:
        """Whether a log that ends before the mark is damaged; else a power cut may have cost its end."""
        return self.power or self.boot == boot() != UNKNOWN

    def against(self, end: int, chains: Mapping[int, int]) -> str:
        """Says what is wrong with a log; empty if nothing is.

        Args:
            end: its newest tick.
            chains: the chain of each of its ticks.
        """
        if self.tick > end:
            return f"it ends with tick {end}, and was promised to hold tick {self.tick}"
        if chains.get(self.tick, self.chain) != self.chain:
            return f"its tick {self.tick} is not the one that was promised"
        return ""


class MarkFile:
    """A mark that is open for writing; the file is made with the first note.

    Args:
        path: of the file.
        power: whether transactions are synchronised before their note is made.

    Raises:
        OSError: it cannot be written. So does `write`.
    """

    def __init__(self, path: Path, *, power: bool) -> None:
        self._path, self._power, self._boot = path, power, boot()
        self._file: int | None = None
        self._number = 0

    def write(self, tick: int, chain: int) -> None:
        """Notes that all up to the end of `tick` is on disk."""
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
        """Lets go of the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _note(self, tick: int, chain: int) -> bytes:
        note = SLOT.pack(MAGIC, self._number, tick, chain, self._power, self._boot)
        return note + CHECK.pack(zlib.crc32(note))

    def _open(self, tick: int, chain: int) -> None:
        """Opens the file with its first note in it. It is made under another name, so that it is never empty."""
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
    """The newest note in a file; None if there is no file.

    Raises:
        ValueError: the file holds none.
        OSError: it cannot be read.
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
