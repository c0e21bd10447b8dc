"""One source, two speeds: `shared.kernel` and `shared.bulk` as they are, and compiled where Numba is installed.

A source is loaded a second time under another name, in which its functions are jitted (`shared.jit`); so there is one
source, and neither instance can drift from the other.
"""

import contextlib
import functools
import importlib
import importlib.util
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from shared.jit import COMPILED, OPTIONS


def available() -> bool:
    """Whether Numba is installed, without importing it."""
    return importlib.util.find_spec("numba") is not None


def of(source: ModuleType, to_compiled: bool) -> ModuleType:
    """The one instance of a source or the other."""
    return compiled(source) if to_compiled else source


@contextlib.contextmanager
def compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Meanwhile calls `tell`, once, as soon as Numba has to compile what is not in its cache on disk."""
    if not available():
        yield
        return
    from numba.core import event

    class Once(event.Listener):
        told = False

        def on_start(self, _: object) -> None:
            if not self.told:
                self.told = True
                tell()

        def on_end(self, _: object) -> None:
            pass

    with event.install_listener("numba:compile", Once()):
        yield


def lent(array: np.ndarray[Any, Any], to_compiled: bool) -> Any:
    """An array, flat, as the kernel wants it: memoryviews give the plain source Python's own whole numbers."""
    flat = array.reshape(-1)
    return flat if to_compiled else memoryview(flat)  # type: ignore[arg-type]


def direct(function: Any, *arguments: Any) -> Any:
    """A kernel function for arguments of these types, without Numba's look at each array of `Arrays` in every call.

    That takes 2 us, more than a client's whole step. Hold the kernel as long as the function.
    """
    if not hasattr(function, "overloads"):
        return function
    from numba import typeof

    types = tuple(map(typeof, arguments))
    function.compile(types)
    return function.overloads[types].entry_point


@functools.cache
def compiled(source: ModuleType) -> ModuleType:
    """The compiled instance of a source.

    Raises:
        ImportError: Numba is not installed.
    """
    config: Any = importlib.import_module("numba.core.config")
    name = source.__name__ + COMPILED
    assert source.__file__ is not None
    spec = importlib.util.spec_from_file_location(name, source.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    place = config.CACHE_DIR
    config.CACHE_DIR = str(
        Path(place or Path(source.__file__).parent / "__pycache__") / f"numba-{_built_in(source):08x}"
    )
    try:
        spec.loader.exec_module(module)
    finally:
        config.CACHE_DIR = place
    return module


def _built_in(source: ModuleType) -> int:
    """A number for what is compiled into a source's functions though it stands in other files: the constants that it
    imports, and how it is compiled. Numba's cache on disk looks at the source alone."""
    constants = sorted((name, value) for name, value in vars(source).items() if isinstance(value, int))
    return zlib.crc32(repr((constants, OPTIONS)).encode())
