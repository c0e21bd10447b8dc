"""Fetches Python for browsers from the package registries, and makes the files that a server hands out at /play."""
