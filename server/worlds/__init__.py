"""Many worlds in one server: kinds, seats, matchmaking, and the directory of worlds. A pure core, without a clock."""
