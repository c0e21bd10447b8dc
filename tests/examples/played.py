"""A game with behaviours, played by bots over a simulated link, and what must hold of it at the end."""

from sovereign_netcode.client_sdk import bots
from sovereign_netcode.client_sdk.events import BehaviourFailed, Diverged, Left
from sovereign_netcode.playtest import PRESETS, Match, bot
from sovereign_netcode.server import Rules
from sovereign_netcode.shared.scene import load_scene

CAUSES = {"late input", "other entity", "server act", "unknown edit", "missing terrain"}
"""Causes of corrections that may occur; "nondeterminism" must not."""


def played(rules: Rules, policies: list[bots.Policy], link: str, seconds: float, seed: int) -> Match:
    """Plays a game with bots, and checks that nothing has failed. Returns the match."""
    match = Match(load_scene(rules.scene), seed, rules=rules)
    for policy in policies:
        match.join(bot(policy), PRESETS[link])
    match.run(seconds)
    check(match)
    return match


def check(match: Match) -> None:
    """Checks that all players play, that every correction has a known cause, and that nothing has failed."""
    assert match.game.counters.rules_failed == 0
    for player in match.players:
        assert player.core.state == "playing"
        assert not [event for event in player.events if isinstance(event, BehaviourFailed | Diverged | Left)]
        assert set(player.core.stats.corrections_by_cause) <= CAUSES
