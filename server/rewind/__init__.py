"""Lag compensation: the world as a client saw it when its player acted."""

from server.rewind.history import Rewind

__all__ = ["Rewind"]
