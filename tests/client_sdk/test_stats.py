"""Counters of a client, and their form for display."""

import pytest

from client_sdk.base import set_link
from client_sdk.core import Core
from client_sdk.events import Corrected
from client_sdk.loopback import Loopback
from client_sdk.netsim.links import Link
from client_sdk.stats import Stats
from server.game import Game
from shared import kernels
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, wander
from tests.lengths import long


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


def test_corrections_are_counted_by_cause() -> None:
    stats = Stats()
    for cause in ("late input", "other entity", "late input"):
        stats.corrected(Corrected(1, ("x",), 0.25, 3, cause))
    assert stats.corrections_by_cause == {"late input": 2, "other entity": 1}
    assert stats.correction_blocks == [0.25] * 3
    figures = dict(stats.figures())
    assert figures["corrections"] == "3"
    assert figures["  late input"] == "2"


def test_a_share_of_nothing_is_nothing() -> None:
    assert Stats().late_share == Stats().late_share_lately == 0
    assert Stats(inputs_late=1, inputs_sent=8).late_share == 0.125
    assert Stats(inputs_late=1, inputs_sent=8).late_share_lately == 0.125, "all of it is new"


def test_late_inputs_are_shown_of_the_last_seconds_and_counted_since_the_start() -> None:
    stats = Stats()
    shown: list[str] = []
    for second in range(30):
        stats.measure(100.0 + second)
        shown.append(dict(stats.figures())["late inputs"])
        stats.inputs_sent += 32
        stats.inputs_late += 16 if 10 <= second < 12 else 0
    assert set(shown[:11]) == set(shown[17:]) == {"0.00 %"}
    assert shown[11:17] == ["10.00 %", "20.00 %", "20.00 %", "20.00 %", "20.00 %", "10.00 %"]
    assert stats.late_share == 32 / (30 * 32)


def test_late_reports_make_no_share_above_one() -> None:
    stats = Stats(inputs_sent=1000)
    for second in range(10):
        stats.measure(float(second))
    stats.inputs_late = 64  # nothing was sent meanwhile
    assert stats.late_share_lately == 1.0


def test_corrections_are_shown_of_the_last_minute_and_counted_since_the_start() -> None:
    stats = Stats()
    for second in range(150):
        stats.measure(float(second))
        if second in (10, 20, 50):
            stats.corrected(Corrected(1, ("x",), 0.25, 3, "late input" if second < 50 else "other entity"))
        expected = {"late input": (10 <= second < 71) + (20 <= second < 81), "other entity": 50 <= second < 111}
        assert stats.corrections_lately == {cause: count for cause, count in expected.items() if count}, second
        assert dict(stats.figures())["corrections"] == str(sum(expected.values()))
    assert stats.corrections == 3
    assert stats.corrections_by_cause == {"late input": 2, "other entity": 1}


def test_marks_are_kept_as_long_as_anything_looks_back() -> None:
    stats = Stats()
    for step in range(60 * 600):
        stats.measure(step / 60)
    assert len(stats._marks) <= 62
    stats.measure(1e6)  # a program that was suspended
    assert len(stats._marks) <= 2
    assert stats.late_share_lately == 0


def test_one_late_pong_is_not_the_round_trip() -> None:
    stats = Stats()
    shown = []
    for round_trip_s in (0.05, 0.05, 0.4, 0.05, 0.06, 0.6, 0.61, 0.6, 0.05, 0.05):
        stats.pinged(round_trip_s)
        shown.append(stats.rtt_s)
    assert shown == [0.05, 0.05, 0.05, 0.05, 0.06, 0.06, 0.6, 0.6, 0.6, 0.05]


@pytest.mark.parametrize(("before_s", "after_s"), [(0.0, 0.3), (0.3, 0.0), *long((0.02, 0.5), (0.1, 0.12))])
def test_the_round_trip_is_that_of_the_last_seconds(before_s: float, after_s: float) -> None:
    """The shown round trip follows a new latency within seconds. It is not the least of the clock's last 15 s."""
    match = Match(load_scene("flat"), 1)
    core = Core()
    set_link(core, Link(before_s))
    match.join(wander, Link(0.0085), core).frame_s = 0.004
    match.run(20)
    assert core.stats.rtt_s == pytest.approx(0.017 + 2 * before_s, abs=0.005)
    set_link(core, Link(after_s))
    match.run(3.5 + 2 * after_s)
    assert core.stats.rtt_s == pytest.approx(0.017 + 2 * after_s, abs=0.005)
    assert dict(core.stats.figures())["round trip"] == f"{core.stats.rtt_s * 1000:.0f} ms"


def test_the_shown_share_of_late_inputs_recovers_soon() -> None:
    match = Match(load_scene("flat"), 1)
    core = Core()
    match.join(wander, Link(0.02), core)
    match.run(20)
    assert dict(core.stats.figures())["late inputs"] == "0.00 %"
    set_link(core, Link(0.2))  # the inputs on the way arrive 200 ms later
    match.run(1)
    assert float(dict(core.stats.figures())["late inputs"].removesuffix(" %")) > 0
    match.run(15)
    assert dict(core.stats.figures())["late inputs"] == "0.00 %"
    assert core.stats.late_share > 0


def test_figures_are_those_of_the_path() -> None:
    match = Match(load_scene("flat"), 1)
    core = Core()
    match.join(wander, Link(0.05), core)
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
