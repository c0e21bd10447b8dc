"""The rules: one deterministic world that server and client step alike."""
