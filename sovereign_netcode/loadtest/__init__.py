"""The load test: bots on real sockets against a real server process."""
