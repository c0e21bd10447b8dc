"""Timers: methods of the rules that are called at a later tick, also after a restart.

A timer is persisted with the name of the method and its arguments, and not with a function. So the restarted program
finds the method again, in its present version.
"""

from collections.abc import Iterator
from heapq import heapify, heappop, heappush
from typing import Any

from server.game_api.entries import Entries
from server.game_api.turn import Turn
from server.journal.recorded_world import RecordedWorld
from server.rules import Rules, checked_function
from shared.checks import SceneError, duration, text, whole
from shared.payloads import pack_value, unpack_value

TIMERS_MAX = 10_000
"""Maximum number of timers that wait."""
NUMBER_SHIFT = 20
"""Shift from the tick in which a timer was started to its least number. So no number is used twice."""


class Timers:
    """The timers of one game.

    Args:
        entries: tick, method and packed arguments by the number of the timer, as part of the persisted state.
    """

    def __init__(self, entries: Entries) -> None:
        self._entries = entries
        self._queue = [(tick, number) for number, (tick, _, _) in entries.table.items()]
        heapify(self._queue)
        self._number = max(entries.table, default=0)

    @property
    def waiting(self) -> bool:
        """Whether a timer may wait."""
        return bool(self._queue)

    def start(self, now: int, ticks: int, method: str, arguments: bytes) -> int:
        """Starts a timer and returns its number.

        Args:
            now: the tick that is about to be computed.
            ticks: number of ticks to wait, at least 1.
            method: name of the method.
            arguments: its arguments, packed.

        Raises:
            SceneError: too many timers wait already.
        """
        if len(self._entries.table) >= TIMERS_MAX:
            raise SceneError(f"after {method!r}: {TIMERS_MAX} timers wait already")
        self._number = max(self._number + 1, now << NUMBER_SHIFT)
        self._entries.put(self._number, [now + ticks, method, arguments])
        heappush(self._queue, (now + ticks, self._number))
        return self._number

    def cancel(self, number: int) -> bool:
        """Cancels a timer. Returns whether it still waited."""
        waits = number in self._entries.table
        self._entries.drop(number)
        return waits

    def due(self, now: int) -> Iterator[tuple[str, list[Any]]]:
        """Yields methods and arguments of the timers that are due, the earliest first. They no longer wait then."""
        while self._queue and self._queue[0][0] <= now:
            _, number = heappop(self._queue)
            if number in self._entries.table:
                _, method, arguments = self._entries.table[number]
                self._entries.drop(number)
                yield method, unpack_value(arguments)


class TimersApi:
    """The timers of a game, for its rules."""

    turn: Turn
    _timers: Timers
    _rules: Rules
    _world: RecordedWorld

    def after(self, seconds: float, method: str, *arguments: Any) -> int:
        """Calls a method of the rules after some time of the game, ahead of the other hooks of that tick.

        The timer survives a restart; the time in which the server does not run does not count.

        Args:
            seconds: time to wait; at least one tick passes.
            method: name of the method: `self.game.after(3, "respawn", player.entity)`.
            arguments: its arguments, MessagePack values of at most 1,024 bytes together. A tuple arrives as a list.
                Pass the number of an entity in place of a player.

        Returns:
            The number of the timer, for `cancel`.

        Raises:
            RulesError: the rules have no such method, or it is async.
            SceneError: the arguments are no MessagePack values, or 10,000 timers wait already.
        """
        self.turn.check("after")
        ticks = round(duration(seconds, "seconds") * self._world.scene.tick_rate)
        found = getattr(self._rules, text(method, "method", 64), None)
        checked_function(found, f"after: {type(self._rules).__qualname__}.{method}")
        try:
            packed = pack_value(arguments)
        except ValueError as error:
            raise SceneError(f"after {method!r}: arguments = {error}") from error
        return self._timers.start(self._world.tick + 1, max(ticks, 1), method, packed)

    def cancel(self, timer: int) -> bool:
        """Cancels a timer.

        Args:
            timer: the number that `after` returned.

        Returns:
            Whether the timer still waited.
        """
        self.turn.check("cancel")
        return self._timers.cancel(whole(timer, "timer", 0, (1 << 63) - 1))
