"""Tag, played by bots over slow links in simulated time: no rule fails, and a recording gives the same game again."""

import io
from itertools import pairwise
from typing import Any

import msgpack
import pytest

from sovereign_netcode.client_sdk.events import Diverged, Happened, Left
from sovereign_netcode.examples.tag import Tag
from sovereign_netcode.examples.tag_brain import TagPlayer
from sovereign_netcode.playtest import Link, Match, Player, bot
from sovereign_netcode.server.journal.records import NOTE, Recording
from sovereign_netcode.server.players.persisted_state import restored
from sovereign_netcode.shared.scene import load_scene
from tests.lengths import contained, long

TYPICAL = Link(0.05, 0.01, 0.01)
CAUSES = {"late input", "other entity", "server act", "unknown edit", "missing terrain"}


class Brief(Tag):
    """Tag with short rounds, so that one ends within a short match."""

    round_s = 40.0


def played(count: int, seconds: float, seed: int, path: Link) -> tuple[Match, list[Player], io.BytesIO]:
    """Plays a recorded game with `count` bots. Returns the match, its players and the recording."""
    match = Match(load_scene(Tag.scene), seed, rules=Brief())
    recording = io.BytesIO()
    match.game.world.record(recording)
    players = [match.join(bot(TagPlayer()), path) for _ in range(count)]
    match.run(seconds)
    match.game.world.end_recording()
    recording.seek(0)
    return match, players, recording


def said(match: Match) -> dict[int, Any]:
    return {entity: match.game.api.kept.attributes.get(entity) for entity in match.game.api.entities()}


@pytest.mark.parametrize(("count", "seconds"), [*contained((6, 15)), *long((20, 20))], ids=["short", "long"])
def test_bots_play_tag_and_a_recording_gives_the_same_scores(count: int, seconds: float) -> None:
    match, players, file = played(count, seconds, 21, TYPICAL)
    game = match.game
    assert game.counters.rules_failed == 0
    tagged: list[Happened] = []
    for player in players:
        assert player.core.state == "playing"
        assert not [event for event in player.events if isinstance(event, Diverged | Left)]
        assert player.core.stats.divergences == 0
        assert set(player.core.stats.corrections_by_cause) <= CAUSES
        tagged = [event for event in player.events if isinstance(event, Happened) and event.name == "tagged"]
    assert len(tagged) >= seconds / 30, "they catch each other"
    for one, two in pairwise(tagged):
        assert one.data["who"] == two.data["by"], "the tagged player is it"
        if two.tick - one.tick < game.api.ticks(Tag.safe_s):
            assert two.data["who"] != one.data["by"], "not tagged back at once"

    recording = Recording(file)
    notes = []
    for moment in recording:
        notes += [msgpack.unpackb(call[1], strict_map_key=False) for call in moment.calls if call[0] == NOTE]
    assert recording.world.state_hash() == game.world.state_hash()
    kept = restored(notes)
    assert {entity: kept.attributes.get(entity) for entity in said(match)} == said(match)
    assert kept.shared == dict(game.api.shared)
    scores = [attributes["score"] for attributes in said(match).values()]
    assert max(scores) > 0
