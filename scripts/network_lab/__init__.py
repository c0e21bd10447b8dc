"""The network lab: full matches in simulated time on each kind of link, and their picture."""
