"""The predicted world, and its reconciliation with the server's."""
