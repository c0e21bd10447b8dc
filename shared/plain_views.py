"""The arrays of `shared.plain_arrays`: views of a buffer, with the operators and methods of numpy's."""

import operator
from array import array as buffer
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import compress, repeat
from types import SimpleNamespace
from typing import Any

int64, int32, uint32, uint8, float64, bool_ = "q", "i", "I", "B", "d", "?"
"""Types of elements, as in `struct`."""
SIZES = {int64: 8, int32: 4, uint32: 4, uint8: 1, float64: 8, bool_: 1}
"""Sizes of elements, in bytes."""
WIRE = {"<i8": int64, "<u4": uint32, "<i4": int32}
"""Types of elements in messages. A browser's processor is little-endian, as messages are."""

Shape = tuple[int, ...]
Index = Any
Memory = Any
"""A memoryview with one dimension; its type for type checkers depends on the format, which varies here."""


class ndarray:  # noqa: N801 - numpy's name
    """An array: a view of a buffer."""

    __slots__ = ()
    __hash__ = None  # type: ignore[assignment]
    flags = SimpleNamespace(writeable=True)
    dtype: str
    shape: Shape

    def __eq__(self, other: object) -> Any:
        return self._compare(operator.eq, other)

    def __ne__(self, other: object) -> Any:
        return self._compare(operator.ne, other)

    def __lt__(self, other: Any) -> Any:
        return self._compare(operator.lt, other)

    def __le__(self, other: Any) -> Any:
        return self._compare(operator.le, other)

    def __gt__(self, other: Any) -> Any:
        return self._compare(operator.gt, other)

    def __ge__(self, other: Any) -> Any:
        return self._compare(operator.ge, other)

    def __and__(self, other: Any) -> Any:
        return self._made(operator.and_, other, self.dtype)

    def __or__(self, other: Any) -> Any:
        return self._made(operator.or_, other, self.dtype)

    def __rshift__(self, other: Any) -> Any:
        return self._made(operator.rshift, other, self.dtype)

    def __add__(self, other: Any) -> Any:
        return self._made(operator.add, other, self._wider(other))

    def __sub__(self, other: Any) -> Any:
        return self._made(operator.sub, other, self._wider(other))

    def __mul__(self, other: Any) -> Any:
        return self._made(operator.mul, other, self._wider(other))

    def __truediv__(self, other: Any) -> Any:
        return self._made(operator.truediv, other, float64)

    def __abs__(self) -> Any:
        return shaped(self.dtype, map(abs, self._all()), self.shape)

    def __invert__(self) -> Any:
        assert self.dtype == bool_
        return shaped(bool_, map(operator.not_, self._all()), self.shape)

    @property
    def size(self) -> int:
        """The number of elements."""
        size = 1
        for side in self.shape:
            size *= side
        return size

    @property
    def ndim(self) -> int:
        """The number of dimensions."""
        return len(self.shape)

    def tobytes(self) -> bytes:
        """Returns a copy of the elements as bytes."""
        return bytes(self._run())

    def astype(self, kind: str) -> Any:
        """Returns a copy with elements of another type."""
        kind = WIRE.get(kind, kind)
        return self.copy() if kind == self.dtype else shaped(kind, self._all(), self.shape)

    def copy(self) -> Any:
        """Returns a copy."""
        return view_of(memory_of(bytearray(self._run()), self.dtype), self.shape)

    def _all(self) -> list[Any]:
        """Returns all elements."""
        values: list[Any] = self._run().tolist()
        return values

    def _run(self) -> Memory:
        """Returns all elements in one run of memory, a copy if need be."""
        raise NotImplementedError

    def _other(self, other: Any) -> Iterable[Any]:
        """Returns the second operand of each element."""
        if not isinstance(other, ndarray):
            return repeat(other)
        theirs = other._all()
        return theirs if other.shape == self.shape else theirs * self.shape[0]

    def _wider(self, other: Any) -> str:
        theirs = other.dtype if isinstance(other, ndarray) else float64 if isinstance(other, float) else self.dtype
        return float64 if float64 in (theirs, self.dtype) else self.dtype

    def _compare(self, by: Callable[[Any, Any], Any], other: Any) -> Any:
        return self._made(by, other, bool_)

    def _made(self, by: Callable[[Any, Any], Any], other: Any, kind: str) -> Any:
        return shaped(kind, map(by, self._all(), self._other(other)), self.shape)


class Vector(ndarray):
    """An array of one dimension.

    Args:
        data: its elements; it may be a slice with a step, a column of a matrix.
    """

    __slots__ = ("data", "dtype", "shape")

    def __init__(self, data: Memory) -> None:
        self.data, self.dtype, self.shape = data, data.format, (len(data),)

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[Any]:
        return iter(self.data.tolist())

    def __bytes__(self) -> bytes:
        return bytes(self.data)

    def __getitem__(self, at: Index) -> Any:
        if type(at) is int:
            return self.data[at]
        if type(at) is slice:
            return Vector(self.data[at])
        data = self.data
        return shaped(self.dtype, [data[i] for i in places_of(at)], None)

    def __setitem__(self, at: Index, value: Any) -> None:
        data = self.data
        if type(at) is int:
            data[at] = value
        elif type(at) is slice:
            write(data[at], value)
        else:
            places = places_of(at)
            for i, each in zip(places, repeat(value) if type(value) is int else values_in(value), strict=False):
                data[i] = each

    def item(self, at: int) -> Any:
        """Returns one element."""
        return self.data[at]

    def tolist(self) -> list[Any]:
        """Returns the elements."""
        values: list[Any] = self.data.tolist()
        return values

    def any(self) -> bool:
        """Returns whether any element is true."""
        return any(self.data.tolist())

    def reshape(self, *shape: Any) -> Any:
        """Returns a view with other dimensions, at most two."""
        if shape == (-1,):
            return self
        sides = shape[0] if isinstance(shape[0], tuple) else shape
        return view_of(self.data, sides_of(sides, len(self)))

    def _run(self) -> Memory:
        return self.data if self.data.contiguous else memory_of(self.data.tobytes(), self.dtype)


class Matrix(ndarray):
    """An array of two dimensions.

    Args:
        flat: a buffer that has its rows.
        start: place of the first element in the buffer.
        stride: distance of two rows in the buffer, in elements.
        shape: numbers of rows and columns.
    """

    __slots__ = ("_flat", "_start", "_stride", "dtype", "shape")

    def __init__(self, flat: Memory, start: int, stride: int, shape: Shape) -> None:
        self._flat, self._start, self._stride, self.shape, self.dtype = flat, start, stride, shape, flat.format

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[Vector]:
        return (Vector(row) for row in self._rows())

    def __getitem__(self, at: Index) -> Any:
        if type(at) is tuple:
            rows, columns = at
            if type(rows) is int:
                part = self._row(rows)[columns]
                return part if type(columns) is int else Vector(part)
            if type(rows) is not slice:
                return self._gathered(rows, columns)
            if type(columns) is int:
                return Vector(self._column(rows, columns))
            some: Matrix = self[rows]
            if type(columns) is tuple:
                picked = [row[k] for row in some._rows() for k in columns]
                return shaped(self.dtype, picked, (len(some), len(columns)))
            first, stop, _ = columns.indices(self.shape[1])
            return Matrix(self._flat, some._start + first, self._stride, (len(some), max(stop - first, 0)))
        if type(at) is int:
            return Vector(self._row(at))
        if type(at) is not slice:
            return self.take(at, 0)
        first, stop, step = at.indices(self.shape[0])
        assert step == 1
        start = self._start + first * self._stride
        return Matrix(self._flat, start, self._stride, (max(stop - first, 0), self.shape[1]))

    def __setitem__(self, at: Index, value: Any) -> None:
        if type(at) is tuple:
            rows, columns = at
            if type(rows) is int and type(columns) is int:
                self._row(rows)[columns] = value
            elif type(rows) is int:
                write(self._row(rows)[columns], value)
            elif type(rows) is slice and type(columns) is int:
                write(self._column(rows, columns), value)
            else:
                for row in self._picked(rows):
                    write(row[columns], value)
        elif type(at) is int:
            write(self._row(at), value)
        elif type(at) is slice:
            target = self[at]
            whole = isinstance(value, Matrix) and value.shape == target.shape and value._packed and target._packed
            if whole:
                target._run()[:] = value._run()
            else:
                for k, row in enumerate(target._rows()):
                    write(row, value if type(value) is int else value[k])
        else:
            for row, each in zip(self._picked(at), repeat(value) if type(value) is Vector else value, strict=False):
                write(row, each)

    def item(self, row: int, column: int) -> Any:
        """Returns one element."""
        return self._flat[self._start + row * self._stride + column]

    def take(self, rows: Index, axis: int) -> "Matrix":
        """Returns a copy of some rows: a list, a vector, or a mask of truth values."""
        assert axis == 0
        return joined([self._row(row) for row in places_of(rows)], self.shape[1], self.dtype)

    def tolist(self) -> list[list[Any]]:
        """Returns the elements by row."""
        return [row.tolist() for row in self._rows()]

    @property
    def T(self) -> "Matrix":  # noqa: N802 - numpy's name
        """A copy with rows and columns exchanged."""
        columns = [self._column(slice(None), column).tobytes() for column in range(self.shape[1])]
        return joined(columns, self.shape[0], self.dtype, self.shape[1])

    def all(self, axis: int) -> Vector:
        """Returns for each row whether all elements are true."""
        assert axis == 1
        return shaped(bool_, [all(row.tolist()) for row in self._rows()], None)  # type: ignore[no-any-return]

    def any(self, axis: int) -> Vector:
        """Returns for each row whether any element is true."""
        assert axis == 1
        return shaped(bool_, [any(row.tolist()) for row in self._rows()], None)  # type: ignore[no-any-return]

    def reshape(self, *shape: Any) -> Any:
        """Returns a view with other dimensions, at most two. The rows have to be in one run of memory."""
        assert self._packed
        if shape == (-1,):
            return Vector(self._run())
        sides = shape[0] if isinstance(shape[0], tuple) else shape
        return view_of(self._run(), sides_of(sides, self.size))

    @property
    def _packed(self) -> bool:
        return self._stride == self.shape[1] or self.shape[0] <= 1

    def _row(self, row: int) -> Memory:
        if not -self.shape[0] <= row < self.shape[0]:
            raise IndexError(f"row {row} of {self.shape[0]}")
        start = self._start + (row if row >= 0 else row + self.shape[0]) * self._stride
        return self._flat[start : start + self.shape[1]]

    def _rows(self) -> Iterator[Memory]:
        flat, columns, stride, start = self._flat, self.shape[1], self._stride, self._start
        return (flat[at : at + columns] for at in range(start, start + self.shape[0] * stride, stride or 1))

    def _picked(self, rows: Index) -> Iterator[Memory]:
        return self[rows]._rows() if type(rows) is slice else map(self._row, places_of(rows))

    def _column(self, rows: slice, column: int) -> Memory:
        first, stop, _ = rows.indices(self.shape[0])
        start = self._start + column
        return self._flat[start + first * self._stride : start + stop * self._stride : self._stride or 1]

    def _gathered(self, rows: Index, columns: Index) -> Any:
        places = places_of(rows)
        if type(columns) is int:
            flat, start, stride = self._flat, self._start + columns, self._stride
            return shaped(self.dtype, [flat[start + row * stride] for row in places], None)
        return self.take(places, 0)[:, columns]

    def _run(self) -> Memory:
        if self._packed:
            return self._flat[self._start : self._start + self.size]
        return joined(list(self._rows()), self.shape[1], self.dtype)._flat


def memory_of(data: Any, kind: str) -> Memory:
    """Returns a view of a buffer with elements of a type."""
    view: Memory = memoryview(data).cast("B")
    return view.cast(kind)


def view_of(flat: Memory, shape: Shape) -> Any:
    """Returns a view of a buffer with a shape."""
    return Vector(flat) if len(shape) == 1 else Matrix(flat, 0, shape[1], shape)


def shaped(kind: str, values: Iterable[Any], shape: Shape | None) -> Any:
    """Returns a new array of values, row after row; without a shape, a vector."""
    flat: Memory = memoryview(buffer(kind if kind != bool_ else uint8, values))
    if kind == bool_:
        flat = flat.cast("B").cast(bool_)
    return Vector(flat) if shape is None or len(shape) == 1 else Matrix(flat, 0, shape[1], shape)


def joined(rows: list[Memory], columns: int, kind: str, count: int | None = None) -> Matrix:
    """Returns a new matrix of rows, or of their parts."""
    flat = memory_of(bytearray(b"".join(rows)), kind)
    return Matrix(flat, 0, columns, (len(rows) if count is None else count, columns))


def sides_of(sides: Sequence[int], size: int) -> Shape:
    """Returns a shape in which one side may be -1: what is left."""
    known = 1
    for side in sides:
        known *= side if side >= 0 else 1
    return tuple(side if side >= 0 else size // (known or 1) for side in sides)


def places_of(at: Index) -> Sequence[int]:
    """Returns the places that an index names: a list, a vector of them, or a mask."""
    if isinstance(at, Vector):
        given = at.data.tolist()
        return list(compress(range(len(given)), given)) if at.dtype == bool_ else given
    return at  # type: ignore[no-any-return]


def values_in(values: Any) -> list[Any]:
    return values._all() if isinstance(values, ndarray) else list(values)


def write(target: Memory, value: Any) -> None:
    """Writes a number, numbers or a vector to a part of a buffer."""
    if isinstance(value, Vector):
        value = value.data
    if isinstance(value, memoryview) and value.format == target.format and target.contiguous and value.contiguous:
        target[:] = value
        return
    for k, each in enumerate(repeat(value, len(target)) if isinstance(value, int | float) else value):
        target[k] = each
