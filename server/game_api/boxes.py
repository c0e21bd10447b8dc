"""The boxes of entities as columns of numbers, for comparisons of many at once."""

import numpy as np

from shared.layout import TEMPLATE, Int64s, X
from shared.scene import Scene


class Boxes:
    """The boxes of the templates of a scene."""

    def __init__(self, scene: Scene) -> None:
        rows = np.array([template.row()[:6] for template in scene.templates], np.int64)
        self._low, self._high = rows[:, :3], rows[:, :3] + rows[:, 3:]
        self.widest = int(rows[:, 3].max())
        """Greatest extent along x, in grid steps."""

    def corners(self, states: Int64s) -> tuple[Int64s, Int64s]:
        """Returns the low and the high corners of entities with the given states, [n, 3] each, in grid steps."""
        positions, templates = states[:, X : X + 3], states[:, TEMPLATE]
        return positions + self._low[templates], positions + self._high[templates]
