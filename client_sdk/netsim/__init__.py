"""Simulated links, for tests and demonstrations."""
