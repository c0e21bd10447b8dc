"""Sockets: the WebSocket server and its admission control."""
