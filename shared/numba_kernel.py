"""The kernel sources compiled by Numba, for platforms without a prebuilt kernel and for changes of the sources."""

import functools
import importlib
import zlib
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from shared import exports, freshness
from shared.jit import COMPILED, OPTIONS, second_instance
from shared.layout import Arrays


def functions(sources: Iterable[ModuleType]) -> dict[str, Any]:
    """Compiles all functions of `shared.exports`, or loads them from Numba's cache on disk. Returns them by name.

    Raises:
        ImportError: Numba is not installed.
    """
    from numba import types

    def array(kind: str) -> Any:
        return types.Array(getattr(types, exports.item(kind)[0]), 1, "C")

    named: Any = types.NamedTuple
    world = named([array(kind) for kind in exports.FIELDS.values()], Arrays)
    kinds = {
        exports.WORLD: world,
        exports.NUMBER: types.int64,
        exports.TRUTH: types.boolean,
        "b": types.Bytes(types.uint8, 1, "C", readonly=True),
    }
    found: dict[str, Any] = {}
    for source in sources:
        compiled = jitted(source)
        for name, arguments in exports.of(source).items():
            types_of_arguments = tuple(kinds.get(kind) or array(kind) for kind in arguments)
            function = getattr(compiled, name)
            function.compile(types_of_arguments)
            # A call of the entry point skips Numba's check of each array of `Arrays`, which takes 2 us: more than a
            # whole step of a client.
            found[name] = function.overloads[types_of_arguments].entry_point
    return found


@functools.cache
def jitted(source: ModuleType) -> ModuleType:
    """Loads a second instance of a source, whose functions Numba compiles when they are first called.

    Raises:
        ImportError: Numba is not installed.
    """
    config: Any = importlib.import_module("numba.core.config")
    assert source.__file__ is not None
    path = Path(source.__file__)
    place = config.CACHE_DIR
    # Numba's cache depends on the source file alone, so the folder's name has a checksum of the imported constants.
    kept = f"numba-{zlib.crc32(repr((freshness.constants(source), OPTIONS)).encode()):08x}"
    config.CACHE_DIR = str(Path(place or path.parent / "__pycache__") / kept)
    try:
        return second_instance(path, source.__name__ + COMPILED)
    finally:
        config.CACHE_DIR = place
