"""Estimates of the server's time, and the timeline by which inputs are sent."""
