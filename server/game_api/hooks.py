"""The calls of the rules' hooks by the game, and of the functions that wait for the next tick.

If a hook raises, the exception is logged and counted, and the game goes on.
"""

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from server.declared import RefusedError, checked
from server.game_api.timers import Timers
from server.game_api.turn import OutOfTurnError
from server.game_api.watchers import Watchers
from server.game_api.zones import Zones
from server.journal.recorded_world import RecordedWorld
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players.player import Player
from server.rules import Rules, RulesError, checked_function, checked_result, overrides
from shared import messages
from shared.edits import Edit
from shared.fields import REASON_MAX
from shared.messages import Command, ProtocolError
from shared.payloads import unpack_value

if TYPE_CHECKING:
    from server.game_api.api import GameApi

SOON_MAX = 10_000
"""Maximum number of functions that wait for the next tick."""
TRUTH = (bool, np.bool_)
"""Types of the results of hooks that count as a truth value."""
NOT_ADMITTED = "the game does not let this player join"
"""Reason for a client that the rules refuse without one."""
_FAILED = object()
"""Result of `Hooks._call` for a command whose hook raised."""


class Hooks:
    """The hooks of one game.

    Args:
        stage: the game API.
        world: the world of the game.
        rules: the rules of the game.
        counters: where failed hooks are counted.
        zones: the zones of the game.
        timers: the timers of the game.
        goes_on: whether the game is restored, so that it has started and the present contacts were reported.
    """

    def __init__(
        self,
        stage: "GameApi",
        world: RecordedWorld,
        rules: Rules,
        counters: Counters,
        zones: Zones,
        timers: Timers,
        *,
        goes_on: bool,
    ) -> None:
        self.seen = 0.0
        """View tick of the latest command: server time in ticks at which its sender drew the other entities."""
        self.reason = ""
        """Reason that the rules gave for refusing the latest command; empty: none."""
        self._api, self._world, self._rules, self._counters = stage, world, rules, counters
        self._soon: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self._watchers = Watchers(world, rules, zones, goes_on=goes_on)
        self._started, self._stopped = goes_on, False
        self._timers = timers
        self.names = rules.names
        self._faults = FaultReporter("the rules have failed")

    # -- in the order of a tick ------------------------------------------------------------------------------

    def start(self) -> None:
        """Calls `on_start` in the first tick of a new game, the functions of `soon`, and the methods of due timers."""
        if not self._started:
            self._started = True
            self._call(self._rules.on_start)
        for _ in range(len(self._soon)):  # functions that these pass to `soon` wait for the next tick
            act, arguments = self._soon.popleft()
            self._call(act, *arguments)
        for method, values in self._timers.due(self._world.tick + 1) if self._timers.waiting else ():
            found = getattr(self._rules, method, None)
            self._call(*((self._lacks, method) if found is None else (found, *values)))

    def stop(self) -> None:
        """Calls `on_stop`, once, if the game has started."""
        if self._started and not self._stopped:
            self._stopped = True
            self._call(self._rules.on_stop)

    def left(self, player: Player) -> None:
        """Calls `on_leave`, and removes the player's entity if the rules have not removed it."""
        if player.announced:
            self._call(self._rules.on_leave, player)
        if player.entity in self._world:
            self._api.discard(player.entity)
        self._api.forget_private(player.entity)  # a behaviour may have removed the entity

    def joined(self, player: Player) -> None:
        """Sets the name of a new player as an attribute, and calls `on_join`."""
        if player.name:
            self._api.set(player.entity, "name", player.name)
        player.announced = True
        self._call(self._rules.on_join, player)

    def not_admitted(self, name: str, subject: str) -> str:
        """Returns the reason why a client may not join: it was kicked, or `can_join` refuses it; empty if it may.

        A `can_join` that raises refuses the client.
        """
        banned = self._api.banned(name, subject)
        if banned or not overrides(self._rules, "can_join"):
            return banned
        allowed = self._call(self._can_join, name, subject, failed=False)
        if isinstance(allowed, str):
            return _sendable(allowed) or NOT_ADMITTED
        return "" if allowed else NOT_ADMITTED

    def fell_out(self, entity: int) -> bool:
        """Calls `on_fell_out` for an entity below the floor. Returns whether the rules dealt with it or removed it."""
        seen_to = self._call(self._rules.on_fell_out, entity)
        return (isinstance(seen_to, TRUTH) and bool(seen_to)) or entity not in self._world

    def command(self, player: Player, command: Command) -> int:
        """Carries out a command of a client by `on_command`. Returns the verdict."""
        try:
            payload = unpack_value(command.payload)
        except ProtocolError:
            return messages.INVALID
        self.seen = command.seen
        if not overrides(self._rules, "on_command"):
            return messages.INVALID
        if self._rules.commands:
            try:
                payload = checked(self._rules.commands, command.name, payload)
            except RefusedError as error:
                self.reason = _sendable(str(error))
                return messages.INVALID
        done = self._call(self._rules.on_command, player, command.name, payload, failed=_FAILED)
        if done is _FAILED:
            return messages.FAILED
        if isinstance(done, str):
            self.reason = _sendable(done)
            return messages.FORBIDDEN
        return messages.FORBIDDEN if isinstance(done, TRUTH) and not done else messages.DONE

    def may_edit(self, player: Player, edit: Edit) -> bool:
        """Returns whether the rules allow an edit. A `can_edit` that raises does not allow it."""
        allowed = self._call(self._can_edit, player, edit, failed=False)
        if isinstance(allowed, str):
            self.reason = _sendable(allowed)
            return False
        return bool(allowed)

    def act(self) -> None:
        """Calls the hooks of contacts and zones for what is new, then `on_tick`."""
        if not self._watchers.idle:
            self._watchers.report(self._call)
        self._call(self._rules.on_tick)

    def stepped(self) -> None:
        """Takes note of what the step has changed, for the hooks of contacts and zones. Call it after the step."""
        if not self._watchers.idle:
            self._watchers.stepped()

    # -- called by the game API ------------------------------------------------------------------------------

    @property
    def waiting(self) -> int:
        """The number of functions that wait for the next tick."""
        return len(self._soon)

    def soon(self, act: Callable[..., object], arguments: tuple[Any, ...]) -> None:
        """Adds a function to those that the next tick calls.

        Raises:
            OutOfTurnError: too many functions wait already.
            RulesError: `act` is not a function, or is async.
        """
        checked_function(act, "soon: act")
        if len(self._soon) >= SOON_MAX:
            raise OutOfTurnError(f"soon: {SOON_MAX} functions wait already; does the game tick?")
        self._soon.append((act, arguments))

    def touching(self, entity: int) -> list[int]:
        """Returns the entities that touch an entity now, in ascending order."""
        return self._watchers.contacts.of(entity)

    # -- inside ----------------------------------------------------------------------------------------------

    def _can_edit(self, player: Player, edit: Edit) -> object:
        allowed: object = self._rules.can_edit(player, *edit)
        if allowed is None:
            raise RulesError("can_edit returned None: it must return True, False or a reason")
        return checked_result(allowed, "can_edit")

    def _lacks(self, method: str) -> None:
        """Reports the timer of a saved game whose method the rules no longer have.

        Raises:
            RulesError: always.
        """
        raise RulesError(f"{type(self._rules).__qualname__}.{method}: a timer calls it, but there is no such method")

    def _can_join(self, name: str, subject: str) -> object:
        allowed: object = self._rules.can_join(name, subject)
        if allowed is None:
            raise RulesError("can_join returned None: it must return True, False or a reason")
        return checked_result(allowed, "can_join")

    def _call(self, hook: Any, *arguments: Any, failed: Any = None) -> Any:
        """Calls a hook and returns its result. If it raises, counts and logs that, and returns `failed`."""
        try:
            return checked_result(hook(*arguments), getattr(hook, "__name__", "a function"))
        except Exception:
            self._counters.rules_failed += 1
            self._faults.report(getattr(hook, "__qualname__", repr(hook)))
            return failed


def _sendable(reason: str) -> str:
    """Returns a reason as a text that a message can hold: at most `REASON_MAX` characters that UTF-8 can encode."""
    return reason[:REASON_MAX].encode(errors="replace").decode()
