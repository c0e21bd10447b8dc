"""Rays and boxes among what a client draws: a guess at a hit, until the server's answer arrives."""

from client_sdk.prediction.prediction import Prediction
from client_sdk.view import View
from shared.arrays import np
from shared.checks import Cell
from shared.hits import Targets, boxes_of
from shared.scene import Scene
from shared.units import SEGMENT_SHIFT


class Drawn(Targets):
    """The other entities of a view where it draws them, and the blocks as the client shows them.

    Queries use the functions of the server's lag compensation (`server.rewind.history.Past`). So a shot hits here what
    it hits there, unless the other player or a block has changed in a way that this client does not know yet.

    Args:
        view: the view that the player sees.
        scene: the scene.
        prediction: the predicted world, which has the blocks and the number of the own entity.
    """

    def __init__(self, view: View, scene: Scene, prediction: Prediction) -> None:
        boxes, low, high = boxes_of(scene), [], []
        for other in view.others:
            box = boxes[scene.index_of[other.template]]
            low.append([a + b for a, b in zip(other.position, box[:3], strict=True)])
            high.append([a + b for a, b in zip(low[-1], box[3:], strict=True)])
        ids = np.array([other.entity for other in view.others], np.int64)
        lows, highs = (np.array(each, np.float64).reshape(-1, 3) for each in (low, high))
        super().__init__(ids, lows, highs, prediction.entity)
        self._blocks, self._floor = prediction.predicted.blocks, scene.origin[2] << SEGMENT_SHIFT

    def solid(self, cell: Cell) -> bool:
        kind = self._blocks.get(*cell)
        return cell[2] >= self._floor if kind is None else self._blocks.stops[kind]
