"""The rules that server and client share: the deterministic world, its wire format and its limits."""
