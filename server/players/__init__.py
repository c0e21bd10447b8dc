"""One player: its inputs, and what outlives a connection."""
