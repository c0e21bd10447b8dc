"""The results of the turns of behaviours: removed entities, announcements to clients, and exceptions.

The world takes the turns (`shared.turns`) at the start of its step. After the step, the game processes here what they
did beside the world.
"""

from collections.abc import Callable, Mapping

from server.journal.recorded_world import RecordedWorld
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players.persisted_state import LEFT
from server.players.player import Player
from server.replication.change_log import ChangeLog
from shared.messages import Announce, encode
from shared.turns import Turns


class TurnResults:
    """The results of the turns in one game.

    Args:
        world: the world of the game.
        log: the change log, which is notified of removed entities.
        forget: called with each removed entity; it forgets the values that the rules gave to the entity.
        counters: where failed turns and dropped events are counted.
    """

    def __init__(self, world: RecordedWorld, log: ChangeLog, forget: Callable[[int], None], counters: Counters) -> None:
        self._world, self._log, self._forget, self._counters = world, log, forget, counters
        self._faults = FaultReporter("the rules have failed")

    def removals(self) -> list[int]:
        """Processes the entities that the turns of the latest step have removed. Call it before the log records.

        Returns:
            These entities.
        """
        turns = self._world.turns
        vanished = turns.vanished if turns is not None else []
        for entity in vanished:
            self._world.note([LEFT, entity])
            self._forget(entity)
            self._log.note_removal(entity)
        return vanished

    def others(self, players: Mapping[int, Player], most: int) -> None:
        """Queues the announcements of the latest step, and reports its exceptions. Call it after the log has recorded.

        Args:
            players: the players by entity.
            most: maximum number of events that wait for one player.
        """
        turns = self._world.turns
        if turns is None:
            return
        if turns.announced:
            self._announce(turns, players, most)
        for failure in turns.take_failures() if turns.failures else ():
            self._counters.rules_failed += 1
            try:
                raise failure.error
            except Exception:
                self._faults.report(f"{failure.behaviour}.turn of entity {failure.entity}")

    def _announce(self, turns: Turns, players: Mapping[int, Player], most: int) -> None:
        """Queues announcements for all players who see the entity, and for its own player.

        The client of its own player predicts most of them, and drops these.
        """
        reserved, tick = self._world.extras.spawns, self._world.tick
        for entity, name, payload in turns.announced:
            segment = self._log.segment_at(entity)
            message = encode(Announce(tick, entity, name, payload))
            for player in players.values():
                session = player.session
                if session is None:
                    continue
                own = player.entity <= entity <= player.entity + reserved
                if own or segment is None or segment in session.stream.view.sees:
                    self._counters.events_dropped += player.outbox.add(tick, message, most)
