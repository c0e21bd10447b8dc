"""The game events of one tick: they wait here for the end of the tick, and then go into the players' outboxes."""

from collections.abc import Iterable, Mapping
from typing import Any

from server.observability.counters import Counters
from server.players.player import Player
from shared.checks import SceneError, shown, text
from shared.fields import NAME_MAX
from shared.messages import Happened, encode
from shared.payloads import pack_value


class Outgoing:
    """The game events of the present tick.

    Args:
        counters: where dropped events are counted.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._events: list[tuple[frozenset[int] | None, bytes]] = []
        """Events in order: the entities of the players to send it to (None: all), and the message."""

    def __len__(self) -> int:
        return len(self._events)

    def send(self, tick: int, name: str, data: Any, to: Player | Iterable[Player] | None) -> None:
        """Adds an event.

        Args:
            tick: the present tick.
            name, data, to: as for `GameApi.send`.

        Raises:
            SceneError: the name or the data are too long, the data are no MessagePack value, or `to` is wrong.
        """
        text(name, "name", NAME_MAX)
        try:
            payload = pack_value(data)
        except ValueError as error:
            raise SceneError(f"send {name!r}: data = {error}") from error
        entities = None if to is None else _entities_of(to)
        self._events.append((entities, encode(Happened(tick, name, payload))))

    def deliver(self, players: Mapping[int, Player], tick: int, most: int) -> None:
        """Puts the events into the players' outboxes, also of players without a connection.

        Args:
            players: the players by entity.
            tick: the tick that was computed.
            most: maximum number of events in one outbox.
        """
        for entities, message in self._events:
            for entity in players if entities is None else entities & players.keys():
                player = players[entity]
                if player.inputs.override is None:  # an in-process player has no client to send to
                    self._counters.events_dropped += player.outbox.add(tick, message, most)
        self._events.clear()


def _entities_of(to: object) -> frozenset[int]:
    """Returns the entities of a player or of several players.

    Raises:
        SceneError: `to` is neither.
    """
    players = [to] if isinstance(to, Player) else list(to) if isinstance(to, Iterable) else [None]
    if not all(isinstance(player, Player) for player in players):
        raise SceneError(f"to = {shown(to)}: must be a `Player`, several of them, or None for all")
    return frozenset(player.entity for player in players if isinstance(player, Player))
