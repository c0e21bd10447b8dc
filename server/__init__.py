"""The authoritative game server.

`Rules` is the base class of a game, `Player` what its hooks get, `Limits` the bounds of a server, and `Game` one world
with its clients.
"""

from server.config.limits import Limits
from server.game import Game
from server.players.player import Player
from server.rules import Rules

__all__ = ["Game", "Limits", "Player", "Rules"]
