"""Recordings: every change of a world, and how to compute the world from them."""
