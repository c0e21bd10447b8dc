"""Benchmarks of the physics, the server, its memory, its traffic and its disk."""
