"""Example games: freeze tag, and tag with bots."""
