"""What carries a client's bytes: thin adapters around one `connection.Connection`."""
