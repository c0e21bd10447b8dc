"""Replication: which changes of the world each client is sent, their encoding, and flow control."""
