"""The page /play: the game in a browser, with the client and the game's behaviours in Python."""
