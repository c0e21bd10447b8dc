"""The effects of every preset that a player notices: causes of corrections, stalls, the age of snapshots."""

import pytest

from client_sdk.events import Corrected
from client_sdk.netsim.links import PRESETS
from server.replication.flow_control import FlowControl
from shared.inputs import JUMP, Input
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, Player, wander
from tests.lengths import contained, long, long_but

TICK_MS = 1000 / 32


def settled(match: Match, *players: Player) -> None:
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 60)


@pytest.mark.parametrize("seconds", [*contained(20), *long(60)])
@pytest.mark.parametrize("preset", long_but(["lan", "typical", "dip"], PRESETS))
def test_a_lone_player_is_only_ever_corrected_after_a_late_input(preset: str, seconds: float) -> None:
    match = Match(load_scene("hills"), 11)
    player = match.join(wander, PRESETS[preset])
    settled(match, player)
    match.run(seconds)
    stats = player.core.stats
    assert set(stats.corrections_by_cause) <= {"late input"}
    assert stats.corrections <= stats.inputs_substituted
    assert stats.divergences == 0
    assert preset != "lan" or (stats.corrections == stats.inputs_late == 0)
    assert player.closed is None


@pytest.mark.parametrize("seconds", [*contained(25), *long(60)])
@pytest.mark.parametrize("preset", long_but(["lan", "outage"], PRESETS))
def test_held_keys_survive_every_stall(preset: str, seconds: float) -> None:
    match = Match(load_scene("arena"), 12)
    player = match.join(lambda core, rng: Input(100, 60, JUMP), PRESETS[preset])
    settled(match, player)
    match.run(seconds)
    stats = player.core.stats
    assert stats.corrections <= stats.inputs_neutralised  # the stall was longer than the server repeats an input
    assert preset == "far" or stats.corrections == 0


def ages(preset: str, seconds: float) -> list[float]:
    """Returns the age of the newest snapshot (ms) at every tick, for three players who see each other."""
    match = Match(load_scene("hills"), 13)
    players = [match.join(wander, PRESETS[preset]) for _ in range(3)]
    settled(match, *players)
    match.run(5)
    found: list[float] = []

    def look() -> None:
        for player in players:
            assert player.core.prediction is not None
            found.append((match.game.world.tick - player.core.prediction.confirmed.tick) * TICK_MS)

    match.on_tick.append(look)
    match.run(seconds)
    assert all(player.closed is None for player in players)
    return found


@pytest.mark.parametrize(
    ("preset", "seconds"),
    [
        ("regional", 8),
        *long(("outage", 8)),
        *long(*((preset, 20) for preset in ("lan", "regional", "typical", "far", "wifi", "outage"))),
    ],
)
def test_snapshots_are_as_fresh_as_the_link_delivers(
    preset: str, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = sorted(ages(preset, seconds))
    monkeypatch.setattr(FlowControl, "window", lambda *_: 1 << 40)  # every snapshot is sent in its tick
    sent = sorted(ages(preset, seconds))
    p99 = int(0.99 * len(held))
    assert held[p99] <= sent[p99] + TICK_MS
    if preset in ("lan", "regional"):
        assert held[p99] <= PRESETS[preset].rtt_s * 500 + 2 * TICK_MS


@pytest.mark.parametrize(
    ("preset", "seconds"),
    [*contained(("thin", 10)), *long(("lan", 30), ("typical", 30), ("dip", 40), ("thin", 30))],
)
def test_without_the_systems_count_acknowledgements_keep_snapshots_fresh(
    preset: str, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = sorted(ages(preset, seconds))
    monkeypatch.setattr(Player, "outstanding", lambda player: None)
    acknowledged = sorted(ages(preset, seconds))
    p99 = int(0.99 * len(counted))
    assert acknowledged[p99] <= counted[p99] + 3.5 * TICK_MS


@pytest.mark.parametrize("seconds", [*contained(45), *long(80)])
def test_in_a_dip_snapshots_stay_fresh_and_are_normal_again_at_once(seconds: float) -> None:
    found = ages("dip", seconds)
    assert max(found) <= 500


@pytest.mark.parametrize("seconds", [*contained(20), *long(30, 60)])
def test_a_thin_link_stays_connected_and_sees_fresh_snapshots(seconds: float) -> None:
    found = sorted(ages("thin", seconds))
    assert found[len(found) // 2] <= 250
    assert found[int(0.99 * len(found))] <= 500
    assert found[-1] <= 1000


@pytest.mark.parametrize("seconds", [*contained(8), *long(20)])
def test_on_a_thin_link_no_segment_is_starved(seconds: float) -> None:
    """Ten players see each other. Even the entity that waits longest was sent within the last second."""
    match = Match(load_scene("hills"), 16)
    players = [match.join(wander, PRESETS["thin"]) for _ in range(10)]
    settled(match, *players)
    match.run(10)
    waits: list[int] = []

    def look() -> None:
        for player in players:
            assert player.session is not None
            waits.append(player.session.stream.view.waits(match.game.world.tick))

    match.on_tick.append(look)
    match.run(seconds)
    assert 4 < max(waits) <= 32


@pytest.mark.parametrize("seconds", [*contained(50), *long(150)])
def test_corrections_have_their_fields_distance_and_cause(seconds: float) -> None:
    match = Match(load_scene("hills"), 17)
    player = match.join(wander, PRESETS["far"])
    settled(match, player)
    match.run(seconds)
    corrections = [event for event in player.events if isinstance(event, Corrected)]
    assert corrections
    for event in corrections:
        assert event.fields
        assert event.cause == "late input"
        assert 0 < event.ticks < 96
        assert event.blocks < 5


def test_the_same_seed_gives_the_same_events() -> None:
    def story() -> list[object]:
        match = Match(load_scene("hills"), 15)
        players = [match.join(wander, PRESETS[preset]) for preset in ("wifi", "far")]
        match.run(10)
        return [player.events for player in players] + [match.game.world.state_hash()]

    assert story() == story()
