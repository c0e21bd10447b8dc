"""The client: prediction, reconciliation, interpolation."""
