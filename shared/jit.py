"""Decorators of the kernel's functions: Numba's in the compiled instance of a source, none in the plain instance."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, TypeVar

F = TypeVar("F")

COMPILED = "_compiled"
"""Suffix of the module name under which the compiled instance of a source is loaded (`shared.numba_kernel`)."""
OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
"""Options of Numba. Without reference counts on arrays (`_nrt`) a turn takes 60 ns instead of 2,200; kernels create no
arrays, so they need none."""


class Decorator(Protocol):
    """A decorator that keeps the type of a function."""

    def __call__(self, function: F, /) -> F: ...


def decorators(module: str) -> tuple[Decorator, Decorator]:
    """Returns two decorators for the functions of a module: one that compiles, and one that also inlines.

    Args:
        module: name of the module. Without the suffix `COMPILED`, both decorators change nothing.
    """
    if not module.endswith(COMPILED):
        return _plain, _plain
    import numba

    njit: Any = numba.njit
    return njit(**OPTIONS), njit(**OPTIONS, forceinline=True)


def second_instance(path: Path, name: str) -> ModuleType:
    """Loads a source file as another module, beside the instance that is imported by its own name.

    Args:
        path: the source file.
        name: name of the new module; with the suffix `COMPILED`, `decorators` compiles its functions.
    """
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def _plain(function: F, /) -> F:
    return function
