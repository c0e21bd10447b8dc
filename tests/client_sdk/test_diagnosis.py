"""The diagnosis of a client: a verdict in one word, its reason, advice, and warnings of wrong use."""

import pytest

from client_sdk.diagnosis import ADVICE, DIVERGING, LATE, MATCHED, OTHERS, Diagnosis, Use, diagnosis
from client_sdk.events import Corrected
from client_sdk.loopback import Loopback
from client_sdk.netsim.links import PRESETS
from client_sdk.stats import Stats
from server.game import Game
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, wander

FINE = Use(0, 5.0, True, False)


def found(*causes: str, use: Use = FINE, **counters: int) -> Diagnosis:
    """Returns the diagnosis after corrections by these causes, with these values of other counters."""
    stats = Stats(kernel="prebuilt")
    stats.measure(100.0)
    for name, count in counters.items():
        setattr(stats, name, count)
    for cause in causes:
        stats.corrected(Corrected(1, ("x",), 0.1, 3, cause))
    stats.measure(105.0)
    return diagnosis(stats, use)


@pytest.mark.parametrize(
    ("causes", "verdict"),
    [
        ((), MATCHED),
        (("late input", "late input", "other entity"), LATE),
        (("other entity", "server act"), OTHERS),
        (("late input", "other entity", "other entity"), OTHERS),
        (("other entity", "nondeterminism"), DIVERGING),
    ],
)
def test_the_verdict_follows_from_the_causes_of_the_last_minute(causes: tuple[str, ...], verdict: str) -> None:
    done = found(*causes)
    assert (done.verdict, done.advice) == (verdict, ADVICE[verdict])
    assert done.warnings == []


def test_late_inputs_alone_make_the_verdict_and_a_divergence_outweighs_them() -> None:
    assert found(inputs_sent=100, inputs_late=3).verdict == LATE
    assert found(inputs_sent=1000, inputs_late=3).verdict == MATCHED
    assert found(inputs_sent=100, inputs_late=3, divergences=1).verdict == DIVERGING


def test_wrong_use_is_named() -> None:
    assert "set_input" in found(use=Use(0, 11.0, False, False)).warnings[0]
    assert "1001 events wait" in found(use=Use(1001, 1.0, True, False)).warnings[0]
    assert "update()" in found(resyncs=4).warnings[0]
    moved = ["server act"] * 11
    assert "a behaviour" in found(*moved).warnings[0]
    assert "push()" in found(*moved, use=Use(0, 5.0, True, True)).warnings[0]


def test_corrections_are_kept_with_their_times() -> None:
    match = Match(load_scene("arena"), seed=3)
    player, _ = (match.join(wander, PRESETS["far"]) for _ in range(2))
    match.run(30)
    stats = player.core.stats
    assert [each.blocks for each in stats.correction_times] == stats.correction_blocks != []
    assert all(0 <= stats.measured_at - each.at <= 30 for each in stats.correction_times)


def test_a_client_that_plays_well_is_matched() -> None:
    client = Loopback(Game(load_scene("flat"))).join("Ann")
    for frame in range(300):
        client.poll(frame / 60)
        client.set_input(1, 0)
        client.update(frame / 60)
    assert client.diagnosis() == (MATCHED, "no correction in the last minute", ADVICE[MATCHED], [])
