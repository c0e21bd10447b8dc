"""The window: a game to play, by default on a server of its own, with bots."""
