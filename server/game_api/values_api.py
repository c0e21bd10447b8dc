"""The part of the game API that keeps values of players: those that only their clients get, and those that last.

Values that only a player's own client gets belong to the player, and end with it. Remembered values belong to the
subject of a token, and outlive the player.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from server.game_api import values
from server.game_api.entries import Entries
from server.game_api.turn import Turn
from server.players.persisted_state import PersistedState
from server.players.player import SUBJECT_MAX, Player
from server.replication.outcome import Outcome
from shared.checks import SceneError, shown, text
from shared.fields import NAME_MAX

SUBJECTS_MAX = 10_000
"""Maximum number of subjects with remembered values."""


class ValuesApi:
    """The values of players, for the rules of a game."""

    turn: Turn
    kept: PersistedState
    outcome: Outcome
    _private: Entries
    _subjects: Entries

    def share_with(self, player: Player, name: str, value: Any) -> None:
        """Sets a value that only the client of one player gets, such as a secret role: `client.private[name]`.

        It lasts as long as the player, also over lost connections and restarts. It is sent as it is now. If you change
        a list later, call `share_with` again.

        Args:
            player: the player.
            name: name of the value, 1 to 32 characters.
            value: any MessagePack value of at most 256 bytes; None removes the value.

        Raises:
            SceneError: the player would have more than 32 values, or a value is wrong.
        """
        self.turn.check("share_with")
        entity = self._member(player).entity
        before, payload = self._private.table.get(entity, {}), values.checked(name, value)
        if payload == values.packed(before.get(name)):
            return
        after = values.with_value(before, name, payload, f"player {entity}")
        self._private.put(entity, after)
        self.outcome.private.add(entity)

    def forget_private(self, entity: int) -> None:
        """Forgets the values that only a player got who has left."""
        self._private.drop(entity)

    def shared_with(self, player: Player) -> Mapping[str, Any]:
        """Returns the values that only the client of a player gets, by name, as a copy."""
        known = self._private.table.get(self._member(player).entity, {})
        return MappingProxyType({name: values.copied(value) for name, value in known.items()})

    def remember(self, who: Player | str, name: str, value: Any) -> None:
        """Sets a value of the subject of a token. It outlives the player and, with `--data`, the server.

        Clients do not get it. A server that does not ask for tokens knows no subjects.

        Args:
            who: a player, or a subject.
            name: name of the value, 1 to 32 characters.
            value: any MessagePack value of at most 256 bytes; None removes the value.

        Raises:
            SceneError: the player has no subject, the subject would have more than 32 values, the game more than
                10,000 subjects, or a value is wrong.
        """
        self.turn.check("remember")
        subject = _subject(who)
        if not subject:
            raise SceneError(f"who = {shown(who)}: has no subject; the server must ask for tokens (--auth)")
        before, payload = self._subjects.table.get(subject, {}), values.checked(name, value)
        if payload == values.packed(before.get(name)):
            return
        if not before and len(self._subjects.table) >= SUBJECTS_MAX:
            raise SceneError(f"subject {subject!r}: more than {SUBJECTS_MAX} subjects have values")
        after = values.with_value(before, name, payload, f"subject {subject!r}")
        if after:
            self._subjects.put(subject, after)
        else:
            self._subjects.drop(subject)

    def recall(self, who: Player | str, name: str, default: Any = None) -> Any:
        """Returns a remembered value of a subject, or `default` if there is none. A list or a table is a copy.

        Args:
            who: a player, or a subject. A player without a subject has no values.
            name: name of the value.
            default: returned if there is no such value.
        """
        known = self._subjects.table.get(_subject(who), {})
        return values.copied(known.get(text(name, "name", NAME_MAX), default))

    def _member(self, player: Player) -> Player:
        if player not in self.kept.players.values():
            raise SceneError(f"player = {shown(player)}: must be a `Player` of this game")
        return player


def _subject(who: Player | str) -> str:
    """Returns the subject of a player, or a checked subject."""
    return who.subject if isinstance(who, Player) else text(who, "who", SUBJECT_MAX)
