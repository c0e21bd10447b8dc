"""Records every call of a kernel on a tape, so that another machine can repeat it: `replay.mjs` does so in WebAssembly.

For each call, a tape holds the changes in the arrays since the last call, the arguments, the result, and the changes
that the call made. So a replay compares every word of every array after every call, bookkeeping included.

    R                                             all arrays are forgotten
    A  u32 array  u32 bytes  u8 unit              a new array, all zero
    W  changes                                    written from outside, ahead of the next call
    C  u8 function  arguments  i32 result  u16 arrays  changes ...   a call, and what it has changed

    arguments     i64 of a number; u32 array  u32 length of an array; that of each array of a world
    changes       u32 array  u32 n  n * u32 index  n * unit bytes

All numbers are little-endian; an index counts units. The order of the functions is that of `exports.functions`.
"""

import struct
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from shared import exports
from shared.kernels import Kernel

BYTES_MAX = 256 << 20
"""Bytes of all recorded arrays. When they exceed it, all arrays are forgotten."""


@dataclass
class Shadow:
    """An array on the tape: its number there, and its bytes after the latest call."""

    number: int
    data: bytes


Touched = tuple[Shadow, np.ndarray[Any, Any]]
"""An array that a call gets: its shadow, and its units as they are now."""
WORLDS_MAX = 8
"""Worlds whose arrays are found without a search."""


class Tape:
    """A tape in a file, written call by call.

    Args:
        kernel: makes the calls.
        file: gets the tape.
    """

    def __init__(self, kernel: Kernel, file: BinaryIO) -> None:
        self._kernel, self._file = kernel, file
        self._known: dict[tuple[int, int], Shadow] = {}
        self._worlds: dict[int, tuple[Any, list[Touched], bytes, Any]] = {}
        self._held = 0
        self.calls: dict[str, int] = dict.fromkeys(exports.functions(server=False), 0)

    def kernel(self) -> Kernel:
        """Returns the kernel with recording."""
        functions = {
            name: self._recorded(i, name, kinds)
            for i, (name, kinds) in enumerate(exports.functions(server=False).items())
        }
        return Kernel(**(vars(self._kernel) | {"bound": lambda arrays: arrays} | functions))

    def _recorded(self, number: int, name: str, kinds: str) -> Any:
        function = getattr(self._kernel, name)

        def call(*arguments: Any) -> Any:
            if self._held > BYTES_MAX:
                self._file.write(b"R")
                self._known.clear()
                self._worlds.clear()
                self._held = 0
            touched: list[Touched] = []
            given: list[Any] = []
            words = bytearray(struct.pack("<cB", b"C", number))
            for kind, argument in zip(kinds, arguments, strict=True):
                if kind in (exports.NUMBER, exports.TRUTH):
                    words += struct.pack("<q", argument)
                elif kind == exports.WORLD:
                    _, arrays, packed, argument = self._world(argument)
                    touched += arrays
                    words += packed
                else:
                    shadow, now = self._array(argument)
                    touched.append((shadow, now))
                    words += struct.pack("<II", shadow.number, len(argument))
                given.append(argument)
            for shadow, now in touched:
                if changes := _changes(shadow, now):
                    self._file.write(b"W" + changes)
            result = function(*given)
            made = [changes for shadow, now in touched if (changes := _changes(shadow, now))]
            self._file.write(bytes(words) + struct.pack("<iH", int(result or 0), len(made)) + b"".join(made))
            self.calls[name] += 1
            return result

        return call

    def _world(self, given: Any) -> tuple[Any, list[Touched], bytes, Any]:
        """Returns the arrays of a world, and what a call gets of them: shadows, packed arguments, its argument.

        The arrays of a world stay where they are, until it has others.
        """
        if id(given) not in self._worlds:
            if len(self._worlds) == WORLDS_MAX:
                self._worlds.clear()
            arrays = [self._array(each) for each in given]
            pairs = zip(arrays, given, strict=True)
            packed = b"".join(struct.pack("<II", shadow.number, len(each)) for (shadow, _), each in pairs)
            self._worlds[id(given)] = given, arrays, packed, self._kernel.bound(given)
        return self._worlds[id(given)]

    def _array(self, given: Any) -> Touched:
        """Returns the shadow of an array, and its units as they are now."""
        raw = np.frombuffer(given, np.uint8) if len(given) else np.zeros(0, np.uint8)
        unit = next(size for size in (8, 4, 1) if len(raw) % size == 0)
        now = raw.view(f"<u{unit}")
        key = (raw.ctypes.data if len(raw) else 0, len(raw))
        if key not in self._known:
            self._known[key] = Shadow(len(self._known), bytes(len(raw)))
            self._held += len(raw)
            self._file.write(struct.pack("<cIIB", b"A", self._known[key].number, len(raw), unit))
        return self._known[key], now


def _changes(shadow: Shadow, now: np.ndarray[Any, Any]) -> bytes:
    """Returns the packed changes of an array since the last time."""
    data = now.tobytes()
    if data == shadow.data:
        return b""
    at = np.flatnonzero(now != np.frombuffer(shadow.data, now.dtype))
    shadow.data = data
    return struct.pack("<II", shadow.number, len(at)) + at.astype("<u4").tobytes() + now[at].tobytes()
