"""The arrays in plain Python do what numpy's do, in all that worlds and clients ask of them."""

import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from shared import plain_arrays as plain

Made = tuple[Any, Any]
"""An array of numpy, and the same in plain Python."""


def listed(value: Any) -> Any:
    """Returns an array as lists, and a number as Python's own."""
    return value.tolist() if hasattr(value, "tolist") else value


def same(theirs: Any, ours: Any) -> None:
    assert listed(ours) == listed(theirs)
    if isinstance(theirs, np.ndarray):
        assert ours.shape == theirs.shape
        assert len(ours) == len(theirs)
        assert ours.size == theirs.size
        assert ours.ndim == theirs.ndim
        assert ours.tobytes() == theirs.tobytes()


def vectors(rng: random.Random, n: int) -> Made:
    values = [rng.randint(-5, 5) for _ in range(n)]
    return np.array(values, np.int64), plain.array(values, plain.int64)


def matrices(rng: random.Random, n: int, columns: int) -> Made:
    rows = [[rng.randint(-(1 << 40), 1 << 40) if k else i for k in range(columns)] for i in range(n)]
    theirs = np.array(rows, np.int64).reshape(n, columns)
    ours = plain.array([part for row in rows for part in row], plain.int64).reshape(n, columns)
    return theirs, ours


READS: dict[str, Callable[[Any, Any], Any]] = {
    "a row": lambda a, _: a[1],
    "the last row": lambda a, _: a[-1],
    "an element": lambda a, _: a[2, 3],
    "item": lambda a, _: a.item(2, 3),
    "a part of a row": lambda a, _: a[2, 1:4],
    "rows": lambda a, _: a[1:3],
    "rows that are not there": lambda a, _: a[2:99],
    "no rows": lambda a, _: a[3:3],
    "columns": lambda a, _: a[:, 1:4],
    "columns of rows": lambda a, _: a[1:4, 2:],
    "columns of columns": lambda a, _: a[:, 1:5][:, 1:3],
    "a column": lambda a, _: a[:, 2],
    "a column of rows": lambda a, _: a[1:4, 2],
    "picked columns": lambda a, _: a[:, (0, 3)],
    "picked rows": lambda a, _: a[[3, 0, 3]],
    "no picked rows": lambda a, _: a[:0],
    "rows by an array": lambda a, np_: a[np_.array([2, 0], np_.int64)],
    "rows by a mask": lambda a, _: a[a[:, 0] != 2],
    "a column by an array": lambda a, np_: a[np_.array([2, 0], np_.int64), 1],
    "columns by an array": lambda a, np_: a[np_.array([2, 0], np_.int64), 1:3],
    "columns by a mask": lambda a, _: a[a[:, 0] > 1][:, (0, 2)],
    "columns as rows": lambda a, _: a[:, 1:4].T,
    "taken": lambda a, np_: a.take(np_.array([1, 1], np_.int64), 0),
    "flat": lambda a, _: a.reshape(-1),
    "another shape": lambda a, _: a.reshape(-1, 3),
    "rows after rows": lambda a, _: a[1:][1:3],
    "comparison": lambda a, _: a[:, 1] >= 0,
    "comparison of columns": lambda a, _: a[:, 1] < a[:, 2],
    "comparison of rows": lambda a, _: (a[:, 1:4] != a[1, 1:4]).any(axis=1),
    "all of a row": lambda a, _: (abs(a[:, 1:4] - a[0, 1:4]) < 1 << 41).all(axis=1),
    "masks": lambda a, _: ((a[:, 1] > 0) & ~(a[:, 2] > 0)) | (a[:, 0] == 1),
    "places of a mask": lambda a, np_: np_.flatnonzero(a[:, 1] > 0),
    "division": lambda a, _: a[:, 1:4] / (1 << 24),
    "sums of floats": lambda a, _: a[:, 1:4] / 16 + a[:, 2:5] / 65536 * 0.37,
    "bits": lambda a, _: (a[:, 1] & 0xFFFF) >> 3,
    "sides": lambda a, np_: np_.concatenate((a[:, :2], a[:, 3:]), axis=1),
    "order": lambda a, np_: np_.argsort(a[:, 3]),
    "order by several": lambda a, np_: np_.lexsort((a[:, 3], a[:, 2], a[:, 1] & 1)),
    "sorted": lambda a, np_: np_.sort(a[:, 3]),
    "one run": lambda a, np_: np_.ascontiguousarray(a[:, 1:3]),
    "a copy": lambda a, _: a[:, 1:3].copy(),
    "zeros": lambda a, np_: np_.zeros((2, 3), np_.int64),
    "nothing": lambda a, np_: np_.zeros((0, 3), np_.float64),
    "full": lambda a, np_: np_.full(5, -1, np_.int32),
    "another type": lambda a, np_: (a[:, 0] & 255).astype(np_.uint8),
    "wire": lambda a, _: a.astype("<i8"),
    "a view of bytes": lambda a, np_: np_.frombuffer(bytes(range(8)), np_.uint32),
    "equality": lambda a, np_: np_.array_equal(a[:, 1:3], a[:, 1:3].copy()),
    "inequality": lambda a, np_: np_.array_equal(a[:, 1:3], a[:, 2:4]),
    "other shapes": lambda a, np_: np_.array_equal(a[1:], a),
}


@pytest.mark.parametrize("name", READS)
def test_reading(name: str) -> None:
    theirs, ours = matrices(random.Random(name), 5, 6)
    same(READS[name](theirs, np), READS[name](ours, plain))


def _set_masked(a: Any, np_: Any) -> None:
    mask = a[:, 0] > 1
    a[mask] = a[mask] - 3


WRITES: dict[str, Callable[[Any, Any], None]] = {
    "an element": lambda a, _: a.__setitem__((1, 2), 7),
    "a row": lambda a, _: a.__setitem__(1, 7),
    "a row from a row": lambda a, _: a.__setitem__(1, a[3]),
    "a part of a row": lambda a, _: a.__setitem__((2, slice(1, 4)), (7, 8, 9)),
    "a column": lambda a, _: a.__setitem__((slice(None), 2), -1),
    "a column of rows": lambda a, _: a.__setitem__((slice(1, 3), 2), -1),
    "a column from a list": lambda a, _: a.__setitem__((slice(None), 0), [5, 4, 3, 2, 1]),
    "a column in place": lambda a, _: a.__setitem__((slice(None), 1), a[:, 1] & 1),
    "rows": lambda a, _: a.__setitem__(slice(1, 3), a[3:5]),
    "rows of columns": lambda a, _: a[:, 1:3].__setitem__(slice(0, 2), a[2:4, 3:5]),
    "rows from zero": lambda a, _: a.__setitem__(slice(2, None), 0),
    "picked rows": lambda a, np_: a.__setitem__(np_.array([4, 0], np_.int64), a[1:3]),
    "picked rows from one": lambda a, np_: a.__setitem__(np_.array([4, 0], np_.int64), a[2]),
    "picked rows from columns": lambda a, np_: a.__setitem__(np_.array([4, 0], np_.int64), a.copy()[:2]),
    "columns of masked rows": lambda a, _: a.__setitem__((~(a[:, 0] > 1), slice(2, 5)), 0),
    "masked rows": _set_masked,
}


@pytest.mark.parametrize("name", WRITES)
def test_writing(name: str) -> None:
    theirs, ours = matrices(random.Random(name), 5, 6)
    WRITES[name](theirs, np)
    WRITES[name](ours, plain)
    same(theirs, ours)


@pytest.mark.parametrize("n", [0, 1, 7])
def test_vectors(n: int) -> None:
    (theirs, ours), (more, own) = (vectors(random.Random(seed), n) for seed in (1, 2))
    reads: tuple[Callable[[Any], Any], ...] = (lambda a: a[1:], lambda a: ~(a == 2), lambda a: a[a > 0])
    for by in reads:
        same(by(theirs), by(ours))
    same(theirs != more, ours != own)
    same((theirs > 0).any(), (ours > 0).any())
    theirs[theirs < 0], ours[ours < 0] = 0, 0
    same(theirs, ours)
    for each in (theirs, ours):
        each[:n] = list(range(n))
    same(theirs, ours)
    assert bytes(ours) == theirs.tobytes()
    assert list(ours) == theirs.tolist()


def test_a_view_shares_its_memory_and_a_copy_does_not() -> None:
    _, ours = matrices(random.Random(3), 4, 5)
    flat, rows, column, copy = ours.reshape(-1), ours[1:3], ours[:, 2], ours.copy()
    ours[1, 2] = 99
    assert flat[7] == rows[0, 2] == column[1] == 99
    assert copy[1, 2] != 99
    column[0] = 98
    assert ours[0, 2] == 98
    assert ours.reshape(-1).data.obj is not None


def test_what_does_not_fit_is_an_error() -> None:
    _, ours = matrices(random.Random(3), 4, 5)
    for wrong in (4, -5):
        with pytest.raises(IndexError):
            ours[wrong]
    with pytest.raises(IndexError):
        ours[0, 5]
    with pytest.raises(OverflowError):
        plain.array([1 << 63], plain.int64)
    with pytest.raises(TypeError):
        hash(ours)


def test_what_only_a_server_needs_says_that_numpy_is_missing() -> None:
    with pytest.raises(AttributeError, match=r"^argwhere: numpy is not installed, and"):
        plain.argwhere  # noqa: B018
