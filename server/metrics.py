"""`/metrics` in Prometheus' text format: made from `/stats` figures when it is asked for, nothing per tick."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from http import HTTPStatus
from typing import Any

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from server.histogram import Histogram
from server.pages import Page

PREFIX = "sovereign_"
BOUNDS_S = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.256, 0.512, 1.0, 2.0, 4.0)

GAUGES = {
    "clients": "Players in the world.",
    "connections": "Connections, players or not.",
    "entities": "Entities in the world.",
    "entities_awake": "Entities that the step looks at.",
    "segments": "Segments of blocks that are loaded.",
    "tick": "The world's tick.",
    "tick_rate": "Ticks per second that are aimed at.",
    "ready": "1 if /readyz says so.",
    "journal_lag_ticks": "Ticks that have run and are not on disk yet.",
}
COUNTERS = {
    "ticks": "Ticks that have run.",
    "ticks_late": "Ticks that began more than one tick late.",
    "ticks_failed": "Ticks that raised.",
    "skipped_s": "Seconds that no tick stands for.",
    "stalls": "Times that the event loop did nothing for more than half a second.",
    "joined": "Players that have come in.",
    "left": "Players that have left.",
    "resumed": "Players that have come back after a lost connection.",
    "corrections": "Corrections of their prediction that clients have reported.",
    "rules_failed": "Exceptions of the game's rules.",
    "events_dropped": "Events of the game's rules that were dropped because a client's path was full.",
    "malformed": "Messages that were none.",
    "kicked": "Clients closed for what they did, or did not do.",
    "snapshots_sent": "Snapshots sent.",
    "snapshots_skipped": "Snapshots left out because a client's path was full.",
    "snapshot_bytes": "Bytes of snapshots sent.",
    "terrain_bytes": "Bytes of terrain sent.",
    "fell_out": "Entities that fell out of the world.",
    "resyncs": "Clients that asked for everything anew.",
    "internal_errors": "Exceptions that cost a client, a command, a page or a tick.",
}
FATES = ("used", "late", "substituted", "refused")
"""Of inputs."""
LABELLED = {
    "refused_at_door": ("door_refusals", "reason", "Connections and requests refused before a WebSocket opened."),
    "closed": ("closed", "code", "Clients told to go, by close code."),
}


class _Collector:
    """Metrics from figures that are asked for at each scrape; what is not among them is left out."""

    def __init__(
        self, figures: Callable[[], Mapping[str, Any]], durations: Callable[[], Mapping[str, Histogram]]
    ) -> None:
        self._figures = figures
        self._durations = durations

    def describe(self) -> Iterable[Metric]:
        """Nothing is asked for ahead of the first scrape."""
        return ()

    def collect(self) -> Iterator[Metric]:
        figures = self._figures()
        for name, text in GAUGES.items():
            if name in figures:
                yield GaugeMetricFamily(PREFIX + name, text, float(figures[name]))
        for name, text in COUNTERS.items():
            if name in figures:
                yield CounterMetricFamily(PREFIX + name, text, float(figures[name]))
        if "inputs_used" in figures:
            inputs = CounterMetricFamily(PREFIX + "inputs", "Ticks of players by what became of them.", labels=["fate"])
            for fate in FATES:
                inputs.add_metric([fate], figures[f"inputs_{fate}"])
            yield inputs
        for key, (name, label, text) in LABELLED.items():
            family = CounterMetricFamily(PREFIX + name, text, labels=[label])
            for value, count in figures.get(key, {}).items():
                family.add_metric([str(value)], count)
            yield family
        for name, histogram in self._durations().items():
            counts = zip(map(str, BOUNDS_S), histogram.below(BOUNDS_S), strict=True)
            buckets = [*counts, ("+Inf", histogram.count)]
            yield HistogramMetricFamily(PREFIX + name, "Seconds, in buckets.", buckets, histogram.sum_s)


def metrics_page(
    figures: Callable[[], Mapping[str, Any]], durations: Callable[[], Mapping[str, Histogram]]
) -> Callable[[], Page]:
    """The page that makes them; `durations` are histograms by the name of the metric."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Collector(figures, durations))
    ProcessCollector(registry=registry)
    GCCollector(registry=registry)
    return lambda: Page(HTTPStatus.OK, generate_latest(registry), CONTENT_TYPE_PLAIN_0_0_4)
