"""The game events that the rules send: they are checked and encoded here, and become part of the tick's outcome."""

from collections.abc import Iterable
from typing import Any

from server.players.player import Player
from shared.checks import SceneError, shown, text
from shared.fields import NAME_MAX
from shared.messages import Happened, encode
from shared.payloads import pack_value


class Outgoing:
    """The game events of the present tick.

    Args:
        events: where they are added (`Outcome.events`).
    """

    def __init__(self, events: list[tuple[frozenset[int] | None, bytes]]) -> None:
        self._events = events

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


def _entities_of(to: object) -> frozenset[int]:
    """Returns the entities of a player or of several players.

    Raises:
        SceneError: `to` is neither.
    """
    players = [to] if isinstance(to, Player) else list(to) if isinstance(to, Iterable) else [None]
    if not all(isinstance(player, Player) for player in players):
        raise SceneError(f"to = {shown(to)}: must be a `Player`, several of them, or None for all")
    return frozenset(player.entity for player in players if isinstance(player, Player))
