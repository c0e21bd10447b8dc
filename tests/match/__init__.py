"""The former name of `sovereign_netcode.playtest`, kept for fault reports from outside the project."""

from sovereign_netcode.playtest.match import Link as Path
from sovereign_netcode.playtest.match import Match, Player, Policy, bot, wander

__all__ = ["Match", "Path", "Player", "Policy", "bot", "wander"]
