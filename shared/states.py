"""Checks of entities' states. The kernel does not check its rows, and a wrong value would make it read any memory.

The functions need numpy. A client does not call them.
"""

from collections.abc import Iterable
from typing import Any

from shared.arrays import np
from shared.checks import SceneError, shown
from shared.extras import Extras
from shared.inputs import BUTTONS_MAX, MOVE_MAX
from shared.layout import BUTTONS, CELL, COLUMNS, FLAGS, ID, MOVE_X, TEMPLATE, VX, Int64s, X
from shared.units import BLOCK, RANGE_BLOCKS

STATES = CELL
"""Number of columns of a state: id, template, flags, x, y, z, vx, vy, vz, move_x, move_y, buttons."""
ID_MAX = (1 << 31) - 1
"""Greatest id of an entity."""
PLACE_MAX, FAST = 2 * RANGE_BLOCKS * BLOCK, 1 << 30
"""Greatest distance of a position from 0 along an axis, in grid steps, and greatest velocity along an axis, in velocity
steps; no world reaches them."""


def checked_states(states: Iterable[tuple[int, ...]] | Int64s, templates: int, extras: Extras | None = None) -> Int64s:
    """Returns states as an int64 matrix [n, 12], or with the extra columns of a scene.

    Args:
        states: rows of 12 whole numbers (`STATES`), or of these and the extra columns.
        templates: number of templates of the scene.
        extras: the extra columns of the scene; None: it has none.

    Raises:
        SceneError: the rows have another shape or type, a value is out of range, or two rows have one id.
    """
    try:
        found = np.asarray(states if isinstance(states, np.ndarray) else list(states))
    except (TypeError, ValueError, OverflowError) as error:  # rows of different lengths, for example, or no list
        raise SceneError(f"states = {shown(states)}: must be rows of {STATES} whole numbers") from error
    if not found.size:
        return np.zeros((0, STATES), np.int64)
    columns = extras.columns if extras is not None and found.ndim == 2 and found.shape[1] > STATES else ()
    if found.dtype.kind != "i" or found.ndim != 2 or found.shape[1] != STATES + len(columns):
        raise SceneError(f"states = {shown(states)}: must be rows of {STATES} whole numbers")
    matrix = found.astype(np.int64, copy=False)
    low, high = _LOW, _HIGH.copy()
    high[TEMPLATE] = templates - 1
    if columns:
        low = np.append(low, [column.low for column in columns])
        high = np.append(high, [column.high for column in columns])
    bad = np.argwhere((matrix < low) | (matrix > high))
    if len(bad):
        row, column = bad[0].tolist()
        names = [*COLUMNS[:STATES], *(each.name for each in columns)]
        field, value = f"states[{row}].{names[column]}", matrix[row, column]
        raise SceneError(f"{field} = {value}: must be a whole number from {low[column]} to {high[column]}")
    if len(np.unique(matrix[:, ID])) < len(matrix):
        raise SceneError("states: two rows have the same id")
    return matrix


def to_positions(values: Any, field: str) -> Int64s:
    """Converts positions [n, 3] in blocks to grid steps.

    Args:
        values: the positions.
        field: name of the field, for the error.

    Raises:
        SceneError: the shape is another one, or a value is not finite or outside +-2^28 blocks.
    """
    try:
        given = np.asarray(values)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise SceneError(f"{field} = {shown(values)}: must be rows of three numbers") from error
    if given.dtype.kind not in "iuf":
        raise SceneError(f"{field} = {shown(values)}: must be rows of three numbers")
    blocks = given.astype(np.float64)
    if blocks.ndim != 2 or blocks.shape[1] != 3:
        raise SceneError(f"{field}: must be rows of three numbers, not of shape {blocks.shape}")
    bad = np.flatnonzero(~(np.abs(blocks) <= RANGE_BLOCKS).all(axis=1))
    if len(bad):
        raise SceneError(f"{field}[{bad[0]}] = {blocks[bad[0]].tolist()}: outside of +-{RANGE_BLOCKS} blocks")
    size = np.abs(blocks) * BLOCK
    whole = np.floor(size)
    whole += size - whole >= 0.5
    steps: Int64s = np.where(blocks >= 0, whole, -whole).astype(np.int64)
    return steps


_LOW, _HIGH = np.zeros(STATES, np.int64), np.zeros(STATES, np.int64)
"""Lowest and greatest values of the columns of a state; the greatest template depends on the scene."""
for _columns, _low, _high in (
    (ID, 1, ID_MAX), (FLAGS, 0, 255), (slice(X, VX), -PLACE_MAX, PLACE_MAX), (slice(VX, MOVE_X), -FAST, FAST),
    (slice(MOVE_X, BUTTONS), -MOVE_MAX, MOVE_MAX), (BUTTONS, 0, BUTTONS_MAX),
):  # fmt: skip
    _LOW[_columns], _HIGH[_columns] = _low, _high
