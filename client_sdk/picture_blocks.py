"""The blocks as a client shows them: single ones, segments, and which segments have changed since the last look."""

from client_sdk.core import Core
from shared.arrays import PLAIN, Uint8s, np
from shared.blocks import AIR, BLOCKS, Blocks, checked_block, checked_segment
from shared.checks import Cell
from shared.units import SEGMENT


class PictureBlocks:
    """The blocks of a client's predicted world, with the player's own edits that the server has not answered yet.

    Args:
        core: the client's state machine.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._seen: dict[Cell, int] = {}
        """Versions of the segments at the last look."""

    def block(self, x: int, y: int, z: int) -> int | None:
        """Returns the kind of a block, 0 for air; None if its segment is not loaded."""
        blocks = self._blocks
        return None if blocks is None else blocks.get(*checked_block(x, y, z))

    def segment(self, index: Cell) -> Uint8s:
        """Returns the kinds of a segment's blocks, [z, y, x], 32 each, as a copy; air if it is not loaded."""
        cell, blocks = checked_segment(index), self._blocks
        shape = SEGMENT, SEGMENT, SEGMENT
        if PLAIN:
            air = memoryview(bytes(BLOCKS)).cast("B", shape)
            return air if blocks is None or cell not in blocks else blocks.segment(cell)  # type: ignore[return-value]
        if blocks is None or cell not in blocks:
            return np.full(shape, AIR, np.uint8)
        kinds: Uint8s = blocks.segment(cell).reshape(shape).copy()
        return kinds

    def changed(self) -> set[Cell]:
        """Returns the segments that have changed, arrived or gone since the last call. The first call returns all."""
        blocks = self._blocks
        versions: list[int] = [] if blocks is None else blocks.versions.tolist()
        now = {} if blocks is None else {cell: versions[row] for cell, row in blocks.rows.items()}
        before, self._seen = self._seen, now
        return {cell for cell in before.keys() | now.keys() if before.get(cell) != now.get(cell)}

    @property
    def _blocks(self) -> Blocks | None:
        prediction = self._core.prediction
        return None if prediction is None else prediction.predicted.blocks
