"""The worlds of a server within the program: `Loopback(LocalWorlds(...))`, and the worlds of a `Match`.

Theory of operation. One queue has the next tick of each world that somebody is in, and the next look of the server at
all of them. `advance` runs what is due, in the order of the deadlines. Each world has a phase of its own, so that the
ticks of the worlds do not fall together. A world that nobody is in has no entry in the queue.
"""

import dataclasses
from collections.abc import Callable
from heapq import heapify, heappop, heappush
from itertools import count

from server.config.limits import Limits
from server.game import Game
from server.worlds.host import Way
from server.worlds.hosted import HostedWorld
from server.worlds.kinds import Kind
from server.worlds.worlds import Worlds
from shared.behaviours import Behaviour
from shared.checks import SceneError

LOOK_S = 0.1
"""Time between two looks at all worlds, in seconds."""
GOLDEN = 0.6180339887
"""The golden ratio's fraction, which spreads the phases evenly."""


class LocalWorlds:
    """Some kinds of worlds, whose time is the `now` of the calls. Data of kinds with `keep` do not survive their world.

    Args:
        kinds: the kinds of worlds (`server.worlds.kinds.kind_of` makes one).
        default: the game of the default world; None: there is none.
        limits: the limits; None: the defaults. `clients_max` of a world is its kind's `players_max`.
        authenticate: returns the subject of a client's token, as for `Game`.
        seed: source of what is random in the worlds' games.

    Raises:
        SceneError: two kinds have the same name.
    """

    def __init__(
        self,
        *kinds: Kind,
        default: Game | None = None,
        limits: Limits | None = None,
        authenticate: Callable[[str], str] | None = None,
        seed: int = 0,
    ) -> None:
        by_name = {kind.name: kind for kind in kinds}
        if len(by_name) < len(kinds):
            raise SceneError(f"kinds = {', '.join(kind.name for kind in kinds)}: must have different names")
        self._limits, self._authenticate, self._seed = limits or Limits(), authenticate, seed
        self._began = count(1)
        self._order = count()
        self._now = 0.0
        self._rhythms: dict[str, _Rhythm] = {}
        self._queue: list[tuple[float, int, _Rhythm]] = []
        self.core = Worlds(by_name, self._limits, self, default=default, authenticate=authenticate)
        """The worlds: `create`, `end` and `entries`, for example."""
        self._start("*", _Rhythm(lambda now: self.core.tick(now), LOOK_S, 0.0))
        if default is not None:
            self._start("", _Rhythm(lambda now: default.tick(now, now), 1 / default.scene.tick_rate, 0.0))

    @property
    def behaviours(self) -> list[type[Behaviour]]:
        """The classes of the behaviours of all kinds and of the default world."""
        scenes = [kind.scene for kind in self.core.kinds.values()]
        if self.core.default is not None:
            scenes.append(self.core.default.scene)
        codes = (entry.code for scene in scenes for entry in scene.behaviours if entry.code is not None)
        return list(dict.fromkeys(codes))

    @property
    def due(self) -> float:
        """Time of the next tick or look, in seconds."""
        return self._queue[0][0]

    def route(self, path: str, now: float) -> Way | str:
        """Returns what a path leads to, or the reason why it leads nowhere. Call `advance` before."""
        self._now = now
        return self.core.route(path)

    def advance(self, now: float) -> None:
        """Runs all that is due, each at its own deadline."""
        queue = self._queue
        while queue[0][0] <= now:
            due, _, rhythm = heappop(queue)
            if rhythm.stopped:
                continue
            self._now = due
            rhythm.act(due)
            rhythm.number += 1
            heappush(queue, (rhythm.due, next(self._order), rhythm))
        self._now = now

    def restart(self, now: float) -> None:
        """Lets all that would be due by now begin at `now` instead, because the program stood still."""
        self._now = now
        for rhythm in self._rhythms.values():
            rhythm.began, rhythm.number = now + rhythm.phase_s, 0
        self._queue = [(rhythm.due, next(self._order), rhythm) for rhythm in self._rhythms.values()]
        heapify(self._queue)

    # -- the host of the worlds ------------------------------------------------------------------------------

    def begin(self, world: HostedWorld) -> Game:
        """Returns the game of a new world."""
        limits = dataclasses.replace(self._limits, clients_max=world.kind.players_max)
        seed = self._seed * 1_000_003 + next(self._began)
        return Game(
            world.kind.scene, limits=limits, rules=world.kind.rules(), seed=seed, authenticate=self._authenticate
        )

    def wake(self, world: HostedWorld) -> None:
        """Starts the ticks of a world."""
        tick_s, game = 1 / world.kind.scene.tick_rate, world.game
        phase_s = next(self._began) * GOLDEN % 1 * tick_s
        self._start(world.name, _Rhythm(lambda now: game.tick(now, now), tick_s, phase_s))

    def rest(self, world: HostedWorld) -> None:
        """Stops the ticks of a world."""
        self._rhythms.pop(world.name).stopped = True

    def ended(self, world: HostedWorld, *, keep: bool) -> None:
        """Takes the end of a world; nothing is kept."""

    def _start(self, name: str, rhythm: "_Rhythm") -> None:
        """Adds what is done again and again, from the first multiple of its time after now on."""
        rhythm.began = rhythm.phase_s
        rhythm.number = max(0, -int((rhythm.began - self._now) // rhythm.every_s))
        self._rhythms[name] = rhythm
        heappush(self._queue, (rhythm.due, next(self._order), rhythm))


class _Rhythm:
    """An act that is done again and again.

    Args:
        act: the act, called with its deadline.
        every_s: time between two of them, in seconds.
        phase_s: time by which the first is late, in seconds.
    """

    def __init__(self, act: Callable[[float], None], every_s: float, phase_s: float) -> None:
        self.act, self.every_s, self.phase_s = act, every_s, phase_s
        self.began, self.number = 0.0, 0
        self.stopped = False

    @property
    def due(self) -> float:
        """Time of the next one, in seconds."""
        return self.began + self.number * self.every_s
