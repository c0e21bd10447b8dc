"""The prebuilt kernel in Pyodide: a side module of Emscripten, whose functions take their arguments in one block.

Each function is `i32 NAME(i64* words)`: a number takes one word, an array two (address and length), and a world the
address of the table of its arrays. Finding an address takes as long as a call, so `lent` keeps it beside the view.
"""

import ctypes
from array import array
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from shared import exports

_NOTHING = ctypes.c_char * 0


class Lent(NamedTuple):
    """A flat array with its address and the number of its elements."""

    view: Any
    address: int
    length: int


def lent(values: Any) -> Lent:
    """Returns the flat view of an array with its address."""
    view = values.reshape(-1).data
    return Lent(view, address_of(view), len(view))


def address_of(view: Any) -> int:
    """Returns the address of a buffer that may be written to."""
    return ctypes.addressof(_NOTHING.from_buffer(view))


def table(arrays: Any) -> memoryview:
    """Returns the table of a world's arrays: address and length of each."""
    words = array("q")
    for each in arrays:
        words.append(each.address)
        words.append(each.length)
    return memoryview(words)


def bound(arrays: Any) -> Lent:
    """Returns the table of a world's arrays with its address."""
    made = table(arrays)
    return Lent(made, address_of(made), len(made))


def loaded(path: Path) -> ModuleType:
    """Loads a side module. Returns its functions as a Python module.

    Raises:
        ImportError: it cannot be loaded.
    """
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise ImportError(f"{path}: {error}") from error
    module = ModuleType(path.stem)
    for name, kinds in {**exports.functions(server=False), "built_from": exports.NUMBER}.items():
        setattr(module, name, _function(getattr(library, name), kinds))
    return module


def _function(function: Any, kinds: str) -> Callable[..., int]:
    """Returns a function of the side module with arguments of these kinds (`shared.exports`)."""
    words = array("q", bytes(8 * exports.words_of(kinds)))
    where = words.buffer_info()[0]
    function.argtypes, function.restype = (ctypes.c_uint32,), ctypes.c_int32
    numbers, world = (exports.NUMBER, exports.TRUTH), exports.WORLD

    def call(*arguments: Any) -> int:
        at = 0
        for kind, argument in zip(kinds, arguments, strict=True):
            if kind in numbers:
                words[at] = argument
                at += 1
            elif kind == world:
                words[at] = argument.address
                at += 1
            elif type(argument) is bytes:
                words[at] = ctypes.cast(ctypes.c_char_p(argument), ctypes.c_void_p).value or 0
                words[at + 1] = len(argument)
                at += 2
            else:
                words[at], words[at + 1] = argument.address, argument.length
                at += 2
        result: int = function(where)
        return result

    return call
