"""Counters, metrics, caught errors, HTTP pages and the live page."""
