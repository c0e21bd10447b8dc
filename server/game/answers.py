"""The answers to commands: each verdict waits until no crash can undo the command."""

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

from server.players import persisted_state
from server.players.player import Player


class Answers:
    """The verdicts that are not durable yet.

    Args:
        players: the players by entity.
    """

    def __init__(self, players: Mapping[int, Player]) -> None:
        self._players = players
        self.waiting: deque[tuple[int, tuple[int, int, int, str]]] = deque()
        """The verdicts in order, each with its tick (`Outcome.verdicts`)."""

    def take(self, tick: int, verdicts: list[tuple[int, int, int, str]]) -> None:
        """Takes the verdicts of a tick."""
        for verdict in verdicts:
            self.waiting.append((tick, verdict))

    def release(self, durable: int) -> None:
        """Queues the verdicts up to a durable tick to be sent to the players."""
        while self.waiting and self.waiting[0][0] <= durable:
            entity, number, verdict, reason = self.waiting.popleft()[1]
            if entity in self._players:
                self._players[entity].settle(number, verdict, reason)

    def notes(self) -> Iterator[list[Any]]:
        """Yields the verdicts that are not durable yet, as notes for a checkpoint."""
        for _, verdict in self.waiting:
            if verdict[0] in self._players:
                yield persisted_state.note_of_answer(*verdict)
