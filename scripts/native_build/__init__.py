"""A copy of the sources in build/native, compiled by mypyc, for programs that simulate much."""
