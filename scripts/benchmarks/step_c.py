"""The step in C: built with gcc at the first use, and called on the arrays of a `World`."""

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from shared.world import World

SOURCE = Path(__file__).with_name("step.c")
FLAGS = ("-O2", "-ffp-contract=off", "-shared", "-fPIC")


def available() -> bool:
    """Returns whether gcc is installed."""
    return shutil.which("gcc") is not None


@functools.cache
def library() -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / "step.so"
        subprocess.run(["gcc", *FLAGS, "-o", str(built), str(SOURCE)], check=True)
        return ctypes.CDLL(str(built))


def run(world: World, ticks: int) -> None:
    """Steps a compiled world in C, without inputs. Only a benchmark may use a world's private arrays."""
    step, arrays = library().step, world._arrays
    addresses = [np.asarray(array).ctypes.data for array in arrays]
    struct = (ctypes.c_int64 * (len(addresses) + 1))(*addresses, len(arrays.table))
    for _ in range(ticks):
        world.tick += 1
        step(struct, ctypes.c_int64(world.tick))
