"""The arrays of worlds and clients: numpy's, or those of `shared.plain_arrays` where numpy is not installed.

Servers need numpy. A client does not, so it plays in a browser, too, where numpy would be a third of what is loaded.
"""

from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Int64s = npt.NDArray[np.int64]
    Int32s = npt.NDArray[np.int32]
    Uint32s = npt.NDArray[np.uint32]
    Uint8s = npt.NDArray[np.uint8]
    Float64s = npt.NDArray[np.float64]
    Truths = npt.NDArray[np.bool_]
else:
    try:
        import numpy as np
    except ImportError:
        from shared import plain_arrays as np

    Int64s = Int32s = Uint32s = Uint8s = Float64s = Truths = Any

PLAIN = np.__name__ != "numpy"
"""Whether these are the arrays of `shared.plain_arrays`."""
FEW = 1 << 31 if PLAIN else 16
"""Number of entities up to which Python looks through their rows; numpy takes about 10 us at least."""

A = TypeVar("A", bound="np.ndarray[Any, Any]")

__all__ = ["FEW", "PLAIN", "Float64s", "Int32s", "Int64s", "Truths", "Uint8s", "Uint32s", "flat", "grown", "np"]


def grown(array: A, fill: int, length: int) -> A:
    """Returns a copy of an array with another length; new items are `fill`."""
    new = np.full((length, *array.shape[1:]), fill, array.dtype)
    kept = min(len(array), length)
    new[:kept] = array[:kept]
    return new  # type: ignore[return-value]


def flat(array: Int64s) -> memoryview:
    """Returns a flat view of an array. To write a few numbers there takes less time than numpy does."""
    return array.reshape(-1).data.cast("B").cast("q")
