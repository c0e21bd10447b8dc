"""The rules of the runs: each player counts up by commands, so that a lost or doubled one shows."""

from typing import Any

from server.players.player import Player
from server.rules import Rules


class Tally(Rules):
    """Accepts a player's command with the number that follows its count, and refuses any other one."""

    def on_command(self, player: Player, name: str, data: Any) -> bool:
        if data != self.game.get(player.entity, "count", 0) + 1:
            return False
        self.game.set(player.entity, "count", data)
        return True
