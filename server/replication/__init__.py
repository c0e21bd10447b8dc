"""What each client is sent of the world, and when."""
