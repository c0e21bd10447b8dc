"""The game: players join, act, and get what has changed, once a tick."""

from server.game.game import Game

__all__ = ["Game"]
