"""The checks and the runs of the tests behind `scripts/test`, and the check of the language of texts."""
