"""A scripted player for tests and for the picture in the README: walks, jumps, builds, and waits for a tag."""

import math

from client_sdk.events import Answered, Happened
from client_sdk.view import View
from shared.checks import Cell
from shared.inputs import JUMP, MOVE_MAX
from sovereign_netcode.examples.tag_brain import TagPlayer
from sovereign_netcode.play.iso import FIRST_KIND
from sovereign_netcode.play.window import Window, Wish

TOWER = ((2, 0), (2, -1), (2, -2))
"""Offsets from the player, in blocks, of the columns that it builds: one, two and three blocks high."""
WALK_BLOCKS, JUMP_BLOCKS = 3.0, 1.2
LAG_S = 0.15
TOGETHER = 5
"""Number of figures that should be in the picture."""
PATIENCE_S = 20.0
"""Seconds after which the picture is taken without waiting for a good moment."""


class Script:
    """The script and its progress. It takes the picture at a good moment after one figure has tagged another."""

    def __init__(self, path: str) -> None:
        self.done: dict[str, float] = {}
        """The steps that are done, with the distance or height in blocks or the count."""
        self._path = path
        self._plan: list[Cell] = []
        self._asked: set[int] = set()
        self._player = TagPlayer()
        self._start: tuple[float, float, float] | None = None
        self._lowest = math.inf
        self._began = self._placed_at = self._tagged_at = 0.0

    def __call__(self, window: Window, view: View, now: float) -> Wish:
        for event in window.events:
            if isinstance(event, Answered) and event.number in self._asked and event.done:
                self.done["placed"] = self.done.get("placed", 0) + 1
            if isinstance(event, Happened) and event.name == "tagged" and "placed" in self.done:
                self.done["tagged"] = self.done.get("tagged", 0) + 1
                self._tagged_at = now
        if view.me is None:
            return Wish()
        place = view.me.position
        if self._start is None:
            self._start, self._began = place, now
            window.lag(LAG_S)
            window.ghost = True
        if "walked" not in self.done:  # up on the screen, jumping over obstacles
            way = math.dist(place[:2], self._start[:2])
            if way > WALK_BLOCKS:
                self.done["walked"] = way
            return Wish(-0.7, 0.7, not all(view.me.velocity[:2]))
        if "jumped" not in self.done and _can_jump(window):
            self._lowest = min(self._lowest, place[2])
            if place[2] - self._lowest > JUMP_BLOCKS:
                self.done["jumped"] = place[2] - self._lowest
            return Wish(jump=True)
        if not self._asked and not self._plan:
            if view.me.velocity[2] != 0:
                return Wish()
            x, y, z = (int(part // 1) for part in place)
            self._plan = [(x + i, y + j, z + k) for n, (i, j) in enumerate(TOWER) for k in range(n + 1)]
            self._placed_at = now
        if self._plan and now > self._placed_at:
            self._placed_at = now + 0.15
            self._asked.add(window.client.edit(*self._plan[0], FIRST_KIND + len(self._plan) % 3))
            self._plan.pop(0)
        if self._plan:
            return Wish()
        self._take_picture(window, view, now)
        return self._play(window)

    def _play(self, window: Window) -> Wish:
        """Plays tag like the bots."""
        prediction = window.core.prediction
        assert prediction is not None
        if window.core.entity not in prediction.predicted:
            return Wish()
        self._player.learn(prediction.attributes)
        input_ = self._player(prediction.predicted, window.core.entity)
        return Wish(input_.move_x / MOVE_MAX, input_.move_y / MOVE_MAX, bool(input_.buttons & JUMP))

    def _take_picture(self, window: Window, view: View, now: float) -> None:
        """Takes the picture soon after a tag, with many figures in sight and in motion, or after `PATIENCE_S`."""
        if "tagged" not in self.done or view.me is None:
            return
        me, ghost = view.me.position, window.core.prediction
        assert ghost is not None
        behind = math.dist(ghost.confirmed.position(view.me.entity), me)
        room = min((math.dist(figure.position, me) for figure in view.others), default=9.0)
        near = sum(window.shown(figure.position) for figure in view.figures)
        good = near >= TOGETHER and behind > 0.7 and room > 1.8 and 0.4 < now - self._tagged_at < 3
        if good or now - self._began > PATIENCE_S:
            self.done["in sight"] = len(view.figures)
            window.save(self._path)
            window.over = "the script has ended"


def _can_jump(window: Window) -> bool:
    scene = window.core.scene
    assert scene is not None
    return scene.gravity > 0 and scene.templates[scene.index_of[scene.player]].jump_speed > 0
