"""The part of the game API that removes players, keeps them out, and sends them to other worlds."""

import math
from typing import Any

from server.functions import RulesError
from server.game_api.entries import Entries
from server.game_api.hosting import Hosting
from server.game_api.turn import Turn
from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import PersistedState
from server.players.player import Player
from shared.checks import SceneError, duration, shown, text
from shared.fields import REASON_MAX, TICK_MAX
from shared.messages import Go

BANS_MAX = 10_000
"""Maximum number of players that are kept out. If there are more, the one whose time ends first may join again."""


class PlayersApi:
    """The players of a game, for its rules."""

    turn: Turn
    kept: PersistedState
    _world: RecordedWorld

    def _init_players(self) -> None:
        self._bans = Entries(self._world, self.kept, "bans")
        self.kicked: list[tuple[Player, str]] = []
        """Players to remove, each with the reason. The game removes them at the end of the tick."""
        self.hosting: Hosting | None = None
        """The worlds of the server; None: this game is the only one."""
        self.sent_away: list[tuple[Player, Go]] = []
        """Players who go to other worlds. The game sends them there at the end of the tick."""

    def kick(self, player: Player, reason: str = "", for_s: float | None = None) -> None:
        """Removes a player from the game. The client gets the reason with `Left`, and does not reconnect by itself.

        The connection closes at the end of this tick. `on_leave` follows in the next one.

        Args:
            player: the player.
            reason: text of at most 500 characters for the client.
            for_s: seconds of the game's time for which the player may not join again; `math.inf`: for good; None: the
                player may join again at once. The player is recognised by the subject of the token, or by the name if
                the server does not ask for tokens; without either it is not recognised. This survives a restart.

        Raises:
            SceneError: `player` is not a player of this game, or a value is wrong.
        """
        self.turn.check("kick")
        if player not in self.kept.players.values():
            raise SceneError(f"player = {shown(player)}: must be a `Player` of this game")
        reason = text(reason, "reason", REASON_MAX, shortest=0)
        if for_s is not None:
            wait_s = duration(for_s, "for_s", endless=True)
            wait = TICK_MAX if wait_s == math.inf else round(wait_s * self._world.scene.tick_rate)
            self._ban(_identity(player.name, player.subject), min(self._world.tick + wait, TICK_MAX), reason)
        if player not in [known for known, _ in self.kicked]:
            self.kicked.append((player, reason))

    @property
    def worlds(self) -> "Hosting":
        """The worlds of the server: this one's name and properties, and how to make and find others (docs/worlds.md).

        Raises:
            RulesError: the server has no other worlds.
        """
        if self.hosting is None:
            raise RulesError("worlds: this game runs alone; declare kinds of worlds in the server's settings")
        return self.hosting

    def send_away(self, player: Player, world: str, data: Any = None, reason: str = "") -> bool:
        """Sends a player to another world of the server. The client connects there by itself, and gets `Moved`.

        The player leaves this world in the next tick. In the other one it joins as a new player; `player.handed` is
        `data` there, when `on_join` is called.

        Args:
            player: the player.
            world: name of the world; empty: the default one.
            data: anything that the rules of the other world understand; clients do not see it.
            reason: text of at most 500 characters for the client.

        Returns:
            Whether the player goes; False: its connection is lost at the moment.

        Raises:
            RulesError: the server has no other worlds.
            SceneError: `player` is not a player of this game.
            WorldsError: there is no such world, or it is full.
        """
        self.turn.check("send_away")
        if player not in self.kept.players.values():
            raise SceneError(f"player = {shown(player)}: must be a `Player` of this game")
        reason = text(reason, "reason", REASON_MAX, shortest=0)
        worlds = self.worlds
        if player.session is None or player.session.closed or player in [known for known, _ in self.sent_away]:
            return False
        self.sent_away.append((player, worlds.seat(world, player.subject, data, reason)))
        return True

    def pardon(self, who: str) -> bool:
        """Lets players who were kicked for some time join again. Returns whether there was one.

        Args:
            who: the subject of their tokens, or the name if the server does not ask for tokens.
        """
        self.turn.check("pardon")
        keys = [key for key in (_identity("", who), _identity(who, "")) if key in self._bans.table]
        for key in keys:
            self._bans.drop(key)
        return bool(keys)

    def banned(self, name: str, subject: str) -> str:
        """Returns the reason why a client may not join because of a `kick`; empty if it may."""
        if not self._bans.table:
            return ""
        key = _identity(name, subject)
        until, reason = self._bans.table.get(key, (0, ""))
        left = until - self._world.tick
        if left <= 0:
            return ""
        kicked = "kicked" if not reason else f"kicked: {reason}"
        return kicked if until == TICK_MAX else f"{kicked}; come back in {left / self._world.scene.tick_rate:.0f} s"

    def _ban(self, key: str, until: int, reason: str) -> None:
        if not key:
            return
        for old in [old for old, (end, _) in self._bans.table.items() if end <= self._world.tick]:
            self._bans.drop(old)
        if len(self._bans.table) >= BANS_MAX and key not in self._bans.table:
            self._bans.drop(min(self._bans.table, key=lambda old: (self._bans.table[old][0], old)))
        self._bans.put(key, [until, reason])


def _identity(name: str, subject: str) -> str:
    """Returns the key by which a player is recognised; empty if it has neither a subject nor a name."""
    return f"subject {subject}" if subject else f"name {name.casefold()}" if name else ""
