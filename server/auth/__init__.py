"""Identity of clients: tokens and other authenticators."""
