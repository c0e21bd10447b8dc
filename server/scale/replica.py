"""A replica: a world and its persisted state, computed from the records of a log.

Theory of operation. All replicas take the same records in the same order, so they are equal at every tick; the marks
and hashes in the records prove it (`server.journal.records.redo`). A record of an older epoch is skipped: it is one of
a deposed sequencer. A record that was delivered twice is skipped, too.
"""

from typing import Any

import msgpack

from server.journal.recorded_world import RecordedWorld
from server.journal.records import NOTE, redo
from server.players import persisted_state
from server.players.persisted_state import PersistedState
from server.replication.outcome import Outcome
from server.scale.wire import Record, rows


class GapError(ValueError):
    """A record that does not follow the newest one: records between the two are missing."""


class Replica:
    """A replica of a world.

    Args:
        world: the world at the tick of `log`'s begin; the replica changes it.
        kept: the persisted state at that tick.
    """

    def __init__(self, world: RecordedWorld, kept: PersistedState) -> None:
        self.world, self.kept = world, kept
        self.epoch = 0
        self.batches: dict[str, int] = {}
        """Newest batch of each edge in the newest record."""
        self.homes: dict[int, tuple[str, int]] = {}
        """Edge and client of each player's latest connection."""
        self.events: dict[int, int] = {}
        """Number of game events for each player so far."""
        self.beside: dict[tuple[str, int], int] = {}
        """Players of the clients that prepare a change to another edge, by that edge and its client."""
        self.edges: dict[str, str] = {}
        """Addresses of the edges that take clients, by edge."""
        self.outcome = Outcome()
        """Outcome of the newest record; the caller clears it."""
        self.shared_changed = False
        """Whether the shared values have changed since the caller last set this to False."""

    def copy(self) -> "Replica":
        """Returns an equal replica: the checkpoint that a new edge or standby begins with."""
        world = RecordedWorld(self.world.scene, compiled=self.world.compiled)
        world.restore(self.world)
        notes = msgpack.unpackb(msgpack.packb(persisted_state.whole(self.kept)), strict_map_key=False)
        other = Replica(world, persisted_state.restored(notes))
        other.epoch, other.batches, other.homes = self.epoch, dict(self.batches), dict(self.homes)
        other.beside, other.events, other.edges = dict(self.beside), dict(self.events), dict(self.edges)
        return other

    def take(self, record: Record) -> bool:
        """Takes a record. Returns False if it is skipped.

        Raises:
            GapError: a record before it is missing.
            DivergedError: the replica differs from the sequencer's world.
        """
        if record.journal is None:
            return self._begin(record)
        if record.epoch < self.epoch or record.tick <= self.world.tick:
            return False
        if record.tick != self.world.tick + 1 or record.epoch != self.epoch:
            raise GapError(f"tick {record.tick} of epoch {record.epoch} after {self.world.tick} of {self.epoch}")
        self.batches = dict(rows(record.batches, 2))
        if record.edges is not None:
            self.edges = dict(rows(record.edges, 2))
        outcome = self.outcome
        outcome.acted.update(record.acted)
        outcome.removed += record.removed
        self.world.placing.update(record.placed)
        for call in record.journal[1]:
            if call[0] == NOTE:
                self._note(msgpack.unpackb(call[1], strict_map_key=False))
        redo(self.world, record.journal)
        for entity in record.removed:
            self.kept.attributes.pop(entity, None)
        outcome.events += [(None if to is None else frozenset(to), message) for to, message in record.events]
        for to, _ in outcome.events:
            for entity in self.kept.players if to is None else to:
                self.events[entity] = self.events.get(entity, 0) + 1
        if self.world.turns is not None:
            outcome.announced += self.world.turns.announced
        for edge, client, entity, beside in rows(record.seated, 4):
            if beside:
                self.beside[edge, client] = entity
            else:
                self.beside.pop((edge, client), None)
                self.homes[entity] = (edge, client)
        for edge, client, _, _ in rows(record.ended, 4):
            self.beside.pop((edge, client), None)
            for entity in [entity for entity, home in self.homes.items() if home == (edge, client)]:
                del self.homes[entity]
        return True

    def _begin(self, record: Record) -> bool:
        """Begins an epoch."""
        if record.epoch <= self.epoch:
            return False
        if record.tick != self.world.tick:
            raise GapError(f"epoch {record.epoch} begins after tick {record.tick}, not {self.world.tick}")
        self.epoch, self.batches = record.epoch, dict(rows(record.batches, 2))
        return True

    def _note(self, note: list[Any]) -> None:
        kind, *parts = note
        if kind == persisted_state.ANSWERED:
            entity, number, verdict, *reason = parts
            self.outcome.verdicts.append((entity, number, verdict, *reason, "")[:4])
            return
        persisted_state.take(self.kept, note)
        if kind == persisted_state.ATTRIBUTES:
            self.outcome.attributes.add(parts[0])
        elif kind == persisted_state.ENTRY and parts[0] == "private":
            self.outcome.private.add(parts[1])
        elif kind == persisted_state.SHARED:
            self.shared_changed = True
        elif kind == persisted_state.LEFT:
            self.homes.pop(parts[0], None)
            self.events.pop(parts[0], None)

    def settle(self) -> None:
        """Files the verdicts of the newest record with the players. An edge does this by `Answers` instead."""
        for entity, number, verdict, reason in self.outcome.verdicts:
            if entity in self.kept.players:
                player = self.kept.players[entity]
                player.settle(number, verdict, reason)
                player.verdicts.clear()
        self.outcome.clear()
