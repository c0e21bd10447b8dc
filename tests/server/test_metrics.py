"""The page `/metrics` as Prometheus reads it."""

from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from server.observability.counters import Counters
from server.observability.histogram import Histogram
from server.observability.metrics import BOUNDS_S, COUNTERS, GAUGES, LABELLED, metrics_page
from tests.tables import HELLO, Table


def scraped(figures: dict[str, Any], **durations: Histogram) -> dict[tuple[str, str], float]:
    """Returns the values by the name and the label of each sample."""
    page = metrics_page(lambda: figures, lambda: durations)()
    assert page.status == 200
    families = text_string_to_metric_families(page.body.decode())
    return {
        (sample.name, "".join(sample.labels.values())): sample.value for family in families for sample in family.samples
    }


def test_a_game_in_figures() -> None:
    table = Table()
    table.connect(HELLO)
    table.connect(HELLO)
    table.connect(b"rubbish")
    for _ in range(5):
        table.tick()
    figures = table.game.stats() | {"refused_at_door": {"origin": 2, "joins": 1}, "ready": True}
    found = scraped(figures)
    assert found["sovereign_clients", ""] == found["sovereign_entities", ""] == 2
    assert found["sovereign_tick", ""] == 5
    assert found["sovereign_snapshots_sent_total", ""] == 10
    assert found["sovereign_ready", ""] == 1
    assert found["sovereign_closed_total", "4003"] == 1
    assert found["sovereign_door_refusals_total", "origin"] == 2
    assert {label for name, label in found if name == "sovereign_inputs_total"} == {
        "used", "late", "substituted", "refused",
    }  # fmt: skip
    assert ("process_cpu_seconds_total", "") in found or ("python_gc_collections_total", "0") in found
    assert ("sovereign_ticks_total", "") not in found, "a counter without a source is left out, not 0"


def test_every_counter_of_the_game_is_in_the_metrics() -> None:
    known = {*GAUGES, *COUNTERS, *LABELLED} | {f"inputs_{fate}" for fate in ("used", "late", "substituted", "refused")}
    assert set(Counters.__dataclass_fields__) - known == {"refused"}, "`closed` counts by code"


def test_durations_are_cumulative_and_add_up() -> None:
    histogram = Histogram()
    for ms in (0.1, 0.6, 3.0, 50.0, 10_000.0):
        histogram.record(ms / 1e3)
    found = scraped({}, tick_lateness_seconds=histogram)
    counts = [found["sovereign_tick_lateness_seconds_bucket", str(bound)] for bound in BOUNDS_S]
    assert counts == [1, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 4, 4, 4]
    assert found["sovereign_tick_lateness_seconds_bucket", "+Inf"] == 5
    assert found["sovereign_tick_lateness_seconds_count", ""] == 5
    assert abs(found["sovereign_tick_lateness_seconds_sum", ""] - 10.0537) < 1e-9
