"""The authoritative game: it queues external events, and changes the world in a tick only.

Theory of operation. A message that arrives is checked and queued with its session. The world changes only in `tick`, in
the sequencer half of it (`server.game.sequencer`); the edge half (`server.game.edge`) and the sending follow. Both
halves share one world here. A tick never waits for a client: it sends the newest snapshot to each client whose
connection has room for one. A client that was left out gets the union of what it missed with its next snapshot. An
error of a peer closes its connection with a code and a reason; no message of a peer raises an exception here.
"""

from collections.abc import Callable
from typing import Any

from server.config.limits import Limits
from server.game.clocks import Clocks
from server.game.commands import Commands
from server.game.connections import Connections
from server.game.edge import Edge
from server.game.fast_path import FastPath
from server.game.front import Front
from server.game.joining import Joining
from server.game.roster import Roster
from server.game.sequencer import Sequencer
from server.game_api.api import GameApi
from server.journal.recorded_world import RecordedWorld, Saves
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players import persisted_state
from server.players.persisted_state import PersistedState
from server.rewind import Rewind
from server.rules import Rules, checked_function, equipped
from shared import messages
from shared.checks import SceneError, shown, whole
from shared.scene import Scene

SEED_MAX = (1 << 63) - 1
"""Largest seed of the random numbers."""


class Game(Front):
    """One world, its players and their connections.

    Args:
        scene: the scene to play.
        limits: the limits.
        compiled: whether the kernel is compiled, as for `World`.
        world: the world to play in, with its blocks; None: a new one with the terrain of the scene.
        saves: the store of the world, if it is saved. The game restores the persisted state from it, and sends the
            result of a command when no crash can undo the command any more.
        rules: the rules of the game; None: players can only move and edit.
        seed: seed of the rules' random numbers.
        authenticate: returns the subject of a client's token, or raises a `ValueError`, whose text is sent to the
            refused client. None: anyone may play.
        fast_path: whether sessions that have nothing special to do are served in compiled code, if the kernel is
            compiled. That changes the speed alone.
    """

    joining: Joining
    commands: Commands

    def __init__(
        self,
        scene: Scene,
        *,
        limits: Limits | None = None,
        compiled: bool | None = None,
        world: RecordedWorld | None = None,
        saves: Saves | None = None,
        rules: Rules | None = None,
        seed: int = 0,
        authenticate: Callable[[str], str] | None = None,
        fast_path: bool = True,
    ) -> None:
        for value, at, kind in ((scene, "scene", Scene), (limits, "limits", Limits), (world, "world", RecordedWorld)):
            if not isinstance(value, kind) and (value is not None or kind is Scene):
                raise SceneError(f"{at} = {shown(value)}: must be a `{kind.__name__}`")
        if isinstance(rules, Rules):
            scene = equipped(scene, rules)
        if world is not None and world.scene.fingerprint != scene.fingerprint:
            raise SceneError(f"world: is one of {world.scene!r}, and not of {scene!r}")
        if authenticate is not None:
            checked_function(authenticate, "authenticate")
        whole(seed, "seed", -SEED_MAX, SEED_MAX)
        self.scene = scene
        self.limits = limits or Limits()
        self._row_bytes = scene.input_row_bytes
        if world is None:
            world = RecordedWorld(scene, compiled=compiled)
            world.load_terrain()
        self.world = world
        self.rewind = Rewind(self.world, self.limits.rewind_s)
        self.counters = Counters()
        kept = None
        if saves is not None and self.world.tick > 0:
            kept = persisted_state.restored([*(saves.kept or ()), *(value for _, value in saves.notes)])
        self.api = GameApi(self.world, self.rewind, self.counters, rules or Rules(), kept=kept, seed=seed)
        self.faults = FaultReporter()
        self.roster = Roster(self.world, self.api, self.limits, self.counters)
        self.commands = Commands(self.world, self.api, self.limits, self.faults, saves)
        self.edge = Edge(self.world, self.api.kept, self.limits, self.counters, lambda: self.commands.durable_tick)
        self.log, self.sender = self.edge.log, self.edge.sender
        self.log.faults = self.faults
        self.connections = Connections(self.roster, self.counters, self.faults)
        self.clocks = Clocks(scene.tick_rate, self.limits, self.connections, self.roster)
        self.joining = Joining(
            self.world,
            self.limits,
            self.counters,
            self.faults,
            self.connections,
            self.roster,
            self.commands,
            authenticate,
            rules or Rules(),
        )
        self.sequencer = Sequencer(
            self.world, self.api, self.rewind, self.roster, self.joining, self.commands, self.connections
        )
        if fast_path and self.world.compiled:
            self.fast_path = self.sequencer.fast_path = FastPath(
                self.world,
                self.log,
                self.limits,
                self.counters,
                self.clocks,
                self.players,
                self.connections,
                self.receive,
                self.world.kernel,
            )

    @property
    def newest(self) -> int:
        return self.world.tick

    @property
    def kept(self) -> PersistedState:
        return self.api.kept

    def shut_down(self, reason: str, wait: float, code: int = messages.GOING_AWAY) -> None:
        """Lets the rules finish (`on_stop`), and closes all connections.

        Args:
            reason: the reason, sent to the clients.
            wait: seconds after which the clients should reconnect; negative: they should not.
            code: the close code.
        """
        with self.api.turn:
            self.api.hooks.stop()
        self.connections.shut_down(reason, wait, code)

    def keep(self) -> list[list[Any]]:
        """Returns the persisted state and the unanswered commands as notes, for a checkpoint."""
        return [*persisted_state.whole(self.kept), *self.edge.answers.notes()]

    # -- the tick: the only place where the world changes --------------------------------------------------

    def tick(self, deadline: float, now: float) -> None:
        """Computes the next tick.

        Args:
            deadline: the time at which this tick was due, in seconds of the same clock as `now`. At this moment the
                server time equals the number of the tick.
            now: the current time in seconds.
        """
        if self.fast_path is not None:
            self.fast_path.arrivals.flush()
        self.clocks.begin(deadline, now)
        self.edge.follow(self.sequencer.advance(now))
        self.clocks.refill()
        self._send(self.api.shared_values, now)
        self.sequencer.finish()
        self.clocks.check(now)
