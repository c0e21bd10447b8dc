"""The saved world: checkpoints and a log of each tick's inputs, in one SQLite database.

Rejected: a transaction in the tick (a slow disk would delay every client); a log of states instead of inputs (100 times
the bytes); a file per segment (no transaction spans several files); a copy of the world by fork (not with threads, not
on Windows); a replica that replays the log in the thread (twice the CPU time). A crash loses ticks that clients saw in
snapshots without a verdict, if they were to be in the next transaction.
"""
