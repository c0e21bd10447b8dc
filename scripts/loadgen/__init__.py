"""Processes that put load on a server: many simple players, and hostile peers."""
