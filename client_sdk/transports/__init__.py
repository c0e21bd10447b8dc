"""Transports: thin adapters that move the bytes of a `connection.Connection` between a client and a server."""
