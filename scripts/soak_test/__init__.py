"""The soak test: a server with honest players, churn, kills, stalls and attacks, whose world is checked at the end."""
