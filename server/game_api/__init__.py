"""The game API: what `self.game` is for the rules of a game."""
