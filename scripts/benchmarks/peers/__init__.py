"""`bench.py peers`: other netcode on the same machine, line and game, beside ours."""
