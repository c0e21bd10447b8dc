"""The replay of a recording in another process, which has other hashes of texts, and other addresses."""

import importlib
import io
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from struct import Struct
from typing import BinaryIO

import numpy as np

from server.journal.records import DivergedError, Recording
from shared.behaviours import Behaviour
from shared.layout import Int64s

HEAD = Struct("<qqq")
"""Format of the numbers before the states of a tick: the tick, the number of rows, and the number of columns."""


def played_elsewhere(
    recording: bytes, classes: Sequence[type[Behaviour]], hash_seed: int
) -> Iterator[tuple[int, Int64s]]:
    """Replays a recording in another process. Yields each tick with its states, up to the first that differs.

    Args:
        recording: the recording.
        classes: the behaviours of its scene. The other process imports their modules.
        hash_seed: seed of the hashes of texts in the other process (PYTHONHASHSEED).

    Raises:
        ValueError: a class cannot be imported in another process, or the process has failed.
    """
    names = [f"{each.__module__}:{each.__qualname__}" for each in classes]
    for name, each in zip(names, classes, strict=True):
        if each.__module__ == "__main__" or "<locals>" in name:
            raise ValueError(f"{name}: another process cannot import it; put the class at the top of a module")
    environment = {
        **os.environ,
        "PYTHONHASHSEED": str(hash_seed),
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    command = [sys.executable, "-m", "sovereign_netcode.playtest.elsewhere", *names]
    done = subprocess.run(command, input=recording, capture_output=True, env=environment, check=False)
    if done.returncode:
        raise ValueError(f"the replay in another process has failed: {done.stderr.decode(errors='replace')[-2000:]}")
    out = io.BytesIO(done.stdout)
    while head := out.read(HEAD.size):
        tick, rows, columns = HEAD.unpack(head)
        yield tick, np.frombuffer(out.read(8 * rows * columns), "<i8").astype(np.int64).reshape(rows, columns)


def main(names: Sequence[str], recording: BinaryIO, out: BinaryIO) -> None:
    """Replays a recording, and writes the states of each tick.

    Args:
        names: the classes of the behaviours, as module:Class.
        recording: the recording.
        out: receives the states.
    """
    classes = []
    for name in names:
        module, _, path = name.partition(":")
        found = importlib.import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
        classes.append(found)
    played = Recording(io.BytesIO(recording.read()), behaviours=classes)  # type: ignore[arg-type]
    world = played.world
    with suppress(DivergedError):
        for moment in played:
            if not moment.ended:
                _write(out, world.tick, world.states())
        return
    _write(out, world.tick, world.states())


def _write(out: BinaryIO, tick: int, states: Int64s) -> None:
    out.write(HEAD.pack(tick, *states.shape) + states.astype("<i8", copy=False).tobytes())


if __name__ == "__main__":
    main(sys.argv[1:], sys.stdin.buffer, sys.stdout.buffer)
