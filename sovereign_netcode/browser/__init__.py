"""The Python client for a page: its sources as one archive (`bundle`)."""
