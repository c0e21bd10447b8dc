"""The figures of a load test: several processes put together, the live display, and the reason for a bottleneck."""

import io
import random
from itertools import chain
from typing import Any

import pytest
from rich.console import Console

from server.observability.histogram import Histogram, between
from sovereign_netcode.loadtest import figures, glance

Figures = dict[str, Any]


def client(number: int) -> Figures:
    rng = random.Random(number)
    sizes = [rng.random() for _ in range(rng.randrange(5))]
    return {
        "name": f"bot {number}",
        "left": None,
        "ticks": 320,
        "snapshots": rng.randrange(280, 321),
        "inputs_sent": 320,
        "inputs_late": rng.randrange(9),
        "corrections": len(sizes),
        "correction_blocks": sizes,
        "causes": {"late input": len(sizes)} if sizes else {},
        "repredictions": 0,
        "replayed_ticks": rng.randrange(50),
        "resyncs": 0,
        "bytes_up": rng.randrange(10_000),
        "bytes_down": rng.randrange(100_000),
        "lead_ticks": rng.random(),
        "rtt_ms": rng.random(),
    }


def lags(values_s: list[float]) -> list[list[int]]:
    histogram = Histogram()
    for value in values_s:
        histogram.record(value)
    return histogram.counts()


def result(clients: list[Figures], values_s: list[float], cpu_s: float) -> Figures:
    return {"clients": clients, "cpu_s": cpu_s, "lag_counts": lags(values_s)}


def test_three_processes_have_the_figures_of_one_with_all_their_bots() -> None:
    clients, rng = [client(number) for number in range(12)], random.Random(1)
    parts = [[rng.expovariate(1000) for _ in range(n)] for n in (50, 400, 30)]
    parts[2] = [0.2 + value for value in parts[2]]  # all late values are in one of them
    whole = figures.figures([result(clients, [*chain(*parts)], 6.0)], 10.0, {}, {}, [])
    several = figures.figures(
        [result(clients[4 * i : 4 * i + 4], part, 2.0) for i, part in enumerate(parts)], 10.0, {}, {}, []
    )
    assert several | {"bots": None} == whole | {"bots": None}
    quantiles = [between([], lags(part))["p99"] for part in parts]
    assert [each["lag_ms"]["p99"] for each in several["bots"]] == quantiles
    assert several["bots_lag_ms"]["p99"] > 200 > sum(quantiles) / len(parts)  # not an average of quantiles
    assert [(each["clients"], each["cpu_share"]) for each in several["bots"]] == [(4, 0.2)] * 3


@pytest.mark.parametrize(
    ("lags_s", "cpu_s", "said"),
    [
        ([0.001] * 100, 2.0, ""),
        ([0.029] * 100, 8.9, ""),
        ([0.001] * 60 + [0.05] * 40, 2.0, "other work keeps this machine busy"),
        ([0.05] * 100, 6.0, "more --processes"),  # always late, although other work leaves it no more CPU time
        ([0.001] * 100, 9.5, "more --processes"),
    ],
)
def test_one_process_of_four_that_cannot_keep_up_is_reported(lags_s: list[float], cpu_s: float, said: str) -> None:
    good = [result([client(number)], [0.0005] * 500, 1.0) for number in range(3)]
    found = figures.figures([*good, result([client(3)], lags_s, cpu_s)], 10.0, {}, {}, [])
    told = figures.bottleneck(found)
    assert said in told
    assert bool(told) == bool(said)
    assert (told in [judgement.text for judgement in figures.verdict(found)]) == bool(said)


def bots(at: float, **more: Any) -> Figures:
    counts = {"bytes_down": 0, "bytes_up": 0, "inputs_sent": 0, "inputs_late": 0, "corrections": 0}
    return {"playing": 5, "ended": [], "at": at, "cpu_s": 0.0, "lag_counts": []} | counts | more


def test_a_glance_shows_the_time_since_the_last_one() -> None:
    server = {"ticks": 100, "uptime_s": 50.0, "cpu_s": 4.0, "tick_lateness_counts": [[100, 90], [9000, 10]]}
    later = {"ticks": 164, "uptime_s": 52.0, "cpu_s": 4.5, "tick_lateness_counts": [[100, 153], [9000, 11]]}
    # Each process reports at its own times, and the processes started at different times.
    before = glance.Look(server, [bots(7.0, bytes_down=10_000), bots(900.0, inputs_late=3)])
    now = glance.Look(
        later,
        [
            bots(9.0, bytes_down=30_000, bytes_up=4_000, inputs_sent=320, corrections=2, lag_counts=[[500, 100]]),
            bots(901.0, bytes_down=20_000, inputs_sent=80, inputs_late=7, cpu_s=0.25, lag_counts=[[20_000, 50]])
            | {"playing": 4, "ended": [{"code": 0, "reason": "gone"}]},
        ],
    )
    assert dict(glance.rows(before, now)) == {
        "clients": "9, 1 gone",
        "ticks": "32.0 /s",
        "ticks late": "0.1 / 9.0 / 9.0 ms",
        "server's CPU": "25%",
        "down": "3.33 KB/s each",  # 10,000 and 20,000 bytes/s, nine clients
        "up": "0.22 KB/s each",
        "late inputs": "4 (1.00%)",
        "corrections": "2",
        "bots late": "20.0 ms",
        "bots' CPU": "25%",
    }


def test_a_glance_leaves_out_missing_figures() -> None:
    joining, begun = {"playing": 2, "ended": []}, bots(7.0)
    assert glance.rows(glance.Look({}, [joining]), glance.Look({}, [begun])) == [("clients", "5")]
    both = glance.Look({}, [joining, begun])
    assert glance.rows(both, both) == [("clients", "7"), ("bots silent", "2 of 2 processes")]


@pytest.mark.parametrize("terminal", [False, True])
def test_figures_are_lines_of_their_own_but_on_a_terminal(terminal: bool) -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=60, height=30)
    with glance.Stage(console) as stage:
        stage.begin("5 play", 10.0)
        stage.at(3.0)
        stage.show(3.0, [("clients", "5"), ("ticks", "32.0 /s")])
    said = out.getvalue()
    assert ("\x1b[" in said) == terminal  # on a terminal the picture is drawn anew
    assert ("     3 s  clients 5, ticks 32.0 /s\n" in said) != terminal
    assert "32.0 /s" in said
