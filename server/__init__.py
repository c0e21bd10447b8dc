"""The authoritative game server.

`Rules` is the base class of a game, `Player` what its hooks get, `Limits` the bounds of a server, and `Game` one world
with its clients. `whole_number`, `number`, `words`, `one_of` and `flag` declare the fields of a game's commands. With
many worlds in one server, `Rules.pair` gets each `Ticket`, and a `WorldsError` says why a world cannot be used.
"""

from server.config.limits import Limits
from server.declared import flag, number, one_of, whole_number, words
from server.game import Game
from server.game_api.hosting import WorldsError
from server.players.player import Player
from server.rules import Rules, Ticket

__all__ = [
    "Game",
    "Limits",
    "Player",
    "Rules",
    "Ticket",
    "WorldsError",
    "flag",
    "number",
    "one_of",
    "whole_number",
    "words",
]
