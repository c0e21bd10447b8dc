"""Sovereign Netcode: an authoritative game server and a client that predicts, in Python.

`sovereign_netcode.client_sdk` is the client, `sovereign_netcode.server` the server and the rules of games, and
`sovereign_netcode.shared` the world that both compute.
"""

from sovereign_netcode import _checkout

_checkout.install()
