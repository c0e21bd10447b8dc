"""The former name of `sovereign_netcode.playtest`."""

from sovereign_netcode.playtest.match import Match, Path, Player, Policy, bot, wander

__all__ = ["Match", "Path", "Player", "Policy", "bot", "wander"]
