"""Players: their inputs, and their state beyond a connection."""
