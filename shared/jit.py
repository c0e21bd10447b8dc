"""What turns functions into a kernel: nothing in the plain instance of its source, Numba in the compiled one."""

from typing import Any, Protocol, TypeVar

F = TypeVar("F")

COMPILED = "_compiled"
"""The end of the name under which the compiled instance of a source is loaded (`shared.kernels`)."""
OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
"""Without reference counts on the arrays (`_nrt`) a turn takes 60 ns instead of 2,200: nothing in kernels makes any."""


class Decorator(Protocol):
    """Leaves the type of a function as it is."""

    def __call__(self, function: F, /) -> F: ...


def decorators(module: str) -> tuple[Decorator, Decorator]:
    """For the functions of a module, by its name: the one that compiles, and the one that also inlines."""
    if not module.endswith(COMPILED):
        return _plain, _plain
    import numba

    njit: Any = numba.njit
    return njit(**OPTIONS), njit(**OPTIONS, forceinline=True)


def _plain(function: F, /) -> F:
    return function
