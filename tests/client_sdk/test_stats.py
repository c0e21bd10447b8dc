"""What a client counts, and what a game shows of it."""

import pytest

from client_sdk.events import Corrected
from client_sdk.linked import LinkedCore
from client_sdk.links import Path
from client_sdk.stats import Stats
from client_sdk.transports.loopback import Loopback
from server.game import Game
from shared import kernels
from shared.scene import load_scene
from tests.match import Match, wander


def test_rates_are_those_of_the_last_second() -> None:
    stats = Stats()
    for n in range(17):  # 2 s
        stats.measure(100 + n / 8)
        stats.bytes_up += 8
        stats.bytes_down += 100 if n < 8 else 50
    assert stats.bytes_up_per_s == 64
    assert stats.bytes_down_per_s == 400
    stats.measure(102)
    assert stats.bytes_down_per_s == 400, "the second is not over"


def test_corrections_are_told_by_their_causes() -> None:
    stats = Stats()
    for cause in ("late input", "other entity", "late input"):
        stats.corrected(Corrected(1, ("x",), 0.25, 3, cause))
    assert stats.corrections_by_cause == {"late input": 2, "other entity": 1}
    assert stats.correction_blocks == [0.25] * 3
    figures = dict(stats.figures())
    assert figures["corrections"] == "3"
    assert figures["  late input"] == "2"


def test_a_share_of_nothing_is_nothing() -> None:
    assert Stats().late_share == 0
    assert Stats(inputs_late=1, inputs_sent=8).late_share == 0.125


def test_figures_are_those_of_the_path() -> None:
    match = Match(load_scene("flat"), 1)
    core = LinkedCore()
    match.join(wander, Path(0.05), core)
    match.run(10)
    stats, before = core.stats, core.stats.bytes_up
    match.run(5)
    assert stats.rtt_s == pytest.approx(0.1, abs=1e-3)
    assert 0.05 < stats.lead_s < 0.1
    assert stats.lead_ticks == pytest.approx(stats.lead_s * 32)
    assert 0.05 <= stats.snapshot_age_s < 0.05 + 2 / 32
    assert stats.bytes_up_per_s == pytest.approx((stats.bytes_up - before) / 5, rel=0.1)
    assert stats.bytes_down_per_s > 32 * 20


def test_the_overlay_is_text_to_draw() -> None:
    client = Loopback(Game(load_scene("flat"))).join()
    assert "round trip" in client.overlay(), "before anything is known, too"
    for frame in range(300):
        client.poll(frame / 60)
        client.update(frame / 60)
    lines = client.overlay().splitlines()
    assert [line[:16].strip() for line in lines] == [
        "round trip", "lead", "snapshot age", "up", "down", "late inputs", "corrections", "kernel",
    ]  # fmt: skip
    assert lines[-1].split()[-1] == kernels.chosen()
    assert {len(line) for line in lines} == {26}
    client.stats.reconnects = client.stats.divergences = 1
    assert [line.split()[0] for line in client.overlay().splitlines()[-2:]] == ["reconnects", "DIVERGED"]
