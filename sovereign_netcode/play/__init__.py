"""The desktop window in which a person plays a game, by default on a server of its own, with bots."""
