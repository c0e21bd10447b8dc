"""The time that a test with real sockets, files or processes waits for what must come."""

PATIENCE_S = 60.0
"""Only a fault takes a minute, so a busy machine breaks no test. No test that passes waits until its end."""
