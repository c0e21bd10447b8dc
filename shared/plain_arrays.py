"""The part of numpy that worlds and clients use, in plain Python on memoryviews, for where numpy is not installed.

An array is a `Vector` (one dimension) or a `Matrix` (two); both are views of a buffer, which the kernel fills. Names,
arguments and results are those of numpy, and this module has only what `shared` and `client_sdk` call. Whole numbers
do not overflow here: a value that an array cannot hold is an error.
"""

from array import array as buffer
from collections.abc import Sequence
from typing import Any

from shared.plain_views import (
    SIZES,
    WIRE,
    Matrix,
    Shape,
    Vector,
    bool_,
    float64,
    int32,
    int64,
    joined,
    memory_of,
    ndarray,
    places_of,
    shaped,
    uint8,
    uint32,
    view_of,
)

__all__ = [
    "argsort",
    "array",
    "array_equal",
    "asarray",
    "ascontiguousarray",
    "bool_",
    "concatenate",
    "empty",
    "flatnonzero",
    "float64",
    "frombuffer",
    "full",
    "int32",
    "int64",
    "lexsort",
    "ndarray",
    "sort",
    "uint8",
    "uint32",
    "zeros",
]


def zeros(shape: int | Shape, kind: str = float64) -> Any:
    """Returns a new array of zeros."""
    sides = (shape,) if isinstance(shape, int) else shape
    size = SIZES[kind]
    for side in sides:
        size *= side
    return view_of(memory_of(bytearray(size), kind), sides)


empty = zeros


def full(shape: int | Shape, value: int, kind: str) -> Any:
    """Returns a new array whose elements all have one value."""
    made = zeros(shape, kind)
    if value:
        flat = made.reshape(-1).data
        flat[:] = memoryview(buffer(kind, [value]) * len(flat))
    return made


def array(values: Any, kind: str) -> Any:
    """Returns a new array of numbers, or of rows of numbers."""
    if isinstance(values, ndarray):
        return values.astype(kind)
    rows = list(values)
    if rows and isinstance(rows[0], list | tuple | Vector):
        parts: list[Any] = [part for row in rows for part in row]
        return shaped(kind, parts, (len(rows), len(parts) // len(rows)))
    return shaped(kind, rows, None)


def asarray(values: Any, kind: str | None = None) -> Any:
    """Returns an array of a type, without a copy if it is one already."""
    if isinstance(values, ndarray) and kind in (None, values.dtype):
        return values
    return array(values, kind or int64)


def ascontiguousarray(values: Any) -> Any:
    """Returns an array whose elements are in one run of memory, without a copy if they are already."""
    return view_of(values._run(), values.shape)


def frombuffer(data: Any, kind: str = float64) -> Vector:
    """Returns a view of a buffer."""
    return Vector(memory_of(data, WIRE.get(kind, kind)))


def concatenate(parts: tuple[Matrix, Matrix], axis: int) -> Matrix:
    """Returns two matrices side by side."""
    assert axis == 1
    first, second = parts
    rows = [part for pair in zip(first._rows(), second._rows(), strict=True) for part in pair]
    return joined(rows, first.shape[1] + second.shape[1], first.dtype, len(first))


def array_equal(a: ndarray, b: ndarray) -> bool:
    """Returns whether two arrays have the same shape and elements."""
    return a.shape == b.shape and a.tobytes() == b.tobytes()


def flatnonzero(values: Vector) -> Vector:
    """Returns the places of the true elements."""
    return shaped(int64, places_of(values), None)  # type: ignore[no-any-return]


def argsort(values: Vector) -> Vector:
    """Returns the places of the elements in ascending order."""
    given = values.tolist()
    return shaped(int64, sorted(range(len(given)), key=given.__getitem__), None)  # type: ignore[no-any-return]


def lexsort(keys: Sequence[Vector]) -> Vector:
    """Returns the places of the elements in the order of several keys, the last one first."""
    ranked = list(zip(*(key.tolist() for key in reversed(keys)), strict=True))
    return shaped(int64, sorted(range(len(ranked)), key=ranked.__getitem__), None)  # type: ignore[no-any-return]


def sort(values: Vector) -> Vector:
    """Returns a sorted copy."""
    return shaped(values.dtype, sorted(values.tolist()), None)  # type: ignore[no-any-return]


def __getattr__(name: str) -> Any:
    """Refuses what only a server uses.

    Raises:
        AttributeError: always.
    """
    raise AttributeError(f"{name}: numpy is not installed, and arrays in plain Python do not have this")
