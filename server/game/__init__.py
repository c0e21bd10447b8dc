"""The game: its tick, its sessions and players, and their commands."""

from server.game.game import Game

__all__ = ["Game"]
