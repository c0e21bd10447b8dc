"""What the rules of a game call: `self.game`."""
