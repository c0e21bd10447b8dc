"""Tests of a game: the real server and real clients in simulated time, with bots and simulated connections.

    from sovereign_netcode.playtest import Match, Path, bot

Nothing sleeps, and the result does not depend on the machine. A seed reproduces a match message by message.
"""

from client_sdk.netsim.links import PRESETS, Link
from sovereign_netcode.playtest.checking import BehaviourCheckError, RandomPlayer, check_behaviours
from sovereign_netcode.playtest.local_worlds import LocalWorlds
from sovereign_netcode.playtest.match import Match, Player, Policy, bot, wander

__all__ = [
    "PRESETS",
    "BehaviourCheckError",
    "Link",
    "LocalWorlds",
    "Match",
    "Player",
    "Policy",
    "RandomPlayer",
    "bot",
    "check_behaviours",
    "wander",
]
