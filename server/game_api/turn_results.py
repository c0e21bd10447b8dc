"""The results of the turns of behaviours: removed entities, announcements to clients, and exceptions.

The world takes the turns (`shared.turns`) at the start of its step. After the step, the game processes here what they
did beside the world.
"""

from collections.abc import Callable

from server.journal.recorded_world import RecordedWorld
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players.persisted_state import LEFT
from server.replication.outcome import Outcome


class TurnResults:
    """The results of the turns in one game.

    Args:
        world: the world of the game.
        outcome: where removed entities and announcements are added.
        forget: called with each removed entity; it forgets the values that the rules gave to the entity.
        counters: where failed turns are counted.
    """

    def __init__(
        self, world: RecordedWorld, outcome: Outcome, forget: Callable[[int], None], counters: Counters
    ) -> None:
        self._world, self._outcome, self._forget, self._counters = world, outcome, forget, counters
        self._faults = FaultReporter("the rules have failed")

    def take(self) -> list[int]:
        """Processes the results of the latest step. Returns the entities that it has removed."""
        turns = self._world.turns
        if turns is None:
            return []
        for entity in turns.vanished:
            self._world.note([LEFT, entity])
            self._forget(entity)
            self._outcome.removed.append(entity)
        if turns.announced:
            self._outcome.announced += turns.announced
        for failure in turns.take_failures() if turns.failures else ():
            self._counters.rules_failed += 1
            try:
                raise failure.error
            except Exception:
                self._faults.report(f"{failure.behaviour}.turn of entity {failure.entity}")
        return turns.vanished
