"""The edge half of a game: serves the clients after each tick, from the world and the outcome of the tick.

The world is the one that the sequencer half has changed (`server.game.sequencer`), or a replica of it
(`server.scale`). Nothing here changes the world.
"""

from collections.abc import Callable

from server.config.limits import Limits
from server.game.answers import Answers
from server.observability.counters import Counters
from server.players.persisted_state import PersistedState
from server.replication.change_log import ChangeLog
from server.replication.outcome import Outcome
from server.replication.sender import Sender
from shared.messages import Announce, encode
from shared.world import World


class Edge:
    """The edge half of one game.

    Args:
        world: the world.
        kept: the persisted state: players, attributes and private values.
        limits: the limits.
        counters: where dropped events, snapshots and bytes are counted.
        durable: returns the newest tick that no crash can undo. Verdicts up to it are sent.
        apart: whether announcements have no numbers, because the players change between edges.
    """

    def __init__(
        self,
        world: World,
        kept: PersistedState,
        limits: Limits,
        counters: Counters,
        durable: Callable[[], int],
        *,
        apart: bool = False,
    ) -> None:
        self._numbered = not apart
        self._world, self._kept, self._limits, self._counters = world, kept, limits, counters
        self._durable = durable
        self.log = ChangeLog(world, kept.attributes)
        self.sender = Sender(world, self.log, limits, counters)
        self.answers = Answers(kept.players)

    def follow(self, outcome: Outcome) -> None:
        """Takes the tick that the world has reached: records its changes, and queues what the players get."""
        log, tick, players = self.log, self._world.tick, self._kept.players
        for entity in outcome.acted:
            log.note_act(entity)
        for entity in outcome.attributes:
            log.note_attributes(entity)
        for entity in outcome.removed:
            log.note_removal(entity)
        log.record()
        self.answers.take(tick, outcome.verdicts)
        if self.answers.waiting:
            self.answers.release(self._durable())
        for entity in outcome.private & players.keys() if outcome.private else ():
            session = players[entity].session
            if session is not None:
                session.stream.private_due = self._kept.private_of(entity)
        if outcome.events:
            self._deliver(outcome.events)
        for entity, name, payload in outcome.announced:
            self._announce(entity, name, payload)

    def _deliver(self, events: list[tuple[frozenset[int] | None, bytes]]) -> None:
        """Puts events into the players' outboxes, also of players without a connection."""
        tick, most, everyone = self._world.tick, self._limits.outbox_max, self._kept.players
        for entities, message in events:
            for entity in everyone if entities is None else entities & everyone.keys():
                player = everyone[entity]
                if player.inputs.override is None:  # an in-process player has no client to send to
                    self._counters.events_dropped += player.outbox.add(tick, message, most)

    def _announce(self, entity: int, name: str, payload: bytes) -> None:
        """Queues an announcement for all players who see the entity, and for its own player.

        The client of its own player predicts most of them, and drops these.
        """
        reserved, tick = self._world.extras.spawns, self._world.tick
        segment = self.log.segment_at(entity)
        message = encode(Announce(tick, entity, name, payload))
        for player in self._kept.players.values():
            session = player.session
            if session is None:
                continue
            own = player.entity <= entity <= player.entity + reserved
            if own or segment is None or segment in session.sees:
                most = self._limits.outbox_max
                self._counters.events_dropped += player.outbox.add(tick, message, most, self._numbered)
