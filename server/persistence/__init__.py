"""Saved worlds: the database, its checkpoints, and the start from them."""
