"""The page `/metrics` in Prometheus' text format, computed from the figures of `/stats` at each request."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from http import HTTPStatus
from typing import Any

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from server.observability.histogram import Histogram
from server.observability.pages import Page

PREFIX = "sovereign_"
"""Beginning of the names of all metrics."""
BOUNDS_S = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.256, 0.512, 1.0, 2.0, 4.0)
"""Upper bounds of the buckets of all histograms, in seconds."""

GAUGES = {
    "clients": "Players with a connection.",
    "connections": "Connections, with or without a player.",
    "entities": "Entities in the world.",
    "entities_awake": "Entities that the step computes.",
    "segments": "Segments of blocks that are loaded.",
    "tick": "Number of the world's tick.",
    "tick_rate": "Ticks per second that the server is to run.",
    "ready": "1 if the server is ready (see /readyz), otherwise 0.",
    "journal_lag_ticks": "Ticks that have run and are not on disk yet.",
}
"""Gauges by the name of the figure in `/stats`, with their help texts."""
COUNTERS = {
    "ticks": "Ticks that have run.",
    "ticks_late": "Ticks that began more than one tick late.",
    "ticks_failed": "Ticks that raised an exception.",
    "skipped_s": "Seconds of dropped ticks, which the server did not catch up on.",
    "stalls": "Times that the event loop stood still for more than half a second.",
    "joined": "Players that have joined.",
    "left": "Players that have left.",
    "resumed": "Players that have reconnected after a lost connection.",
    "corrections": "Corrections of their prediction that clients have reported.",
    "rules_failed": "Exceptions in the game's rules.",
    "events_dropped": "Game events dropped because too many waited for one player.",
    "malformed": "Messages of clients that could not be decoded.",
    "kicked": "Clients closed for an error or for silence.",
    "snapshots_sent": "Snapshots sent.",
    "snapshots_skipped": "Snapshots left out because too many bytes were on the way to a client.",
    "snapshot_bytes": "Bytes of snapshots sent.",
    "terrain_bytes": "Bytes of terrain sent.",
    "fell_out": "Entities that fell out of the world.",
    "resyncs": "Requests of clients to get everything anew.",
    "internal_errors": "Exceptions in the server that cost a client, a command, a page or a tick.",
}
"""Counters by the name of the figure in `/stats`, with their help texts."""
FATES = ("used", "late", "substituted", "refused")
"""Values of the label `fate` of the counter of inputs; each is the figure `inputs_...` of `/stats`."""
LABELLED = {
    "refused_at_door": ("door_refusals", "reason", "Connections and requests refused before a WebSocket opened."),
    "closed": ("closed", "code", "Connections that the server closed, by close code."),
}
"""Counters with a label, by the name of the figure in `/stats`: name of the metric, name of the label, help text."""


class _Collector:
    """A collector that computes all metrics from figures at each scrape, and leaves out those without a figure."""

    def __init__(
        self,
        figures: Callable[[], Mapping[str, Any]],
        durations: Callable[[], Mapping[str, Histogram]],
        more: Callable[[], Iterable[Metric]],
    ) -> None:
        self._figures = figures
        self._durations = durations
        self._more = more

    def describe(self) -> Iterable[Metric]:
        """Returns nothing, so that the registry computes no figures before the first scrape."""
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
            inputs = CounterMetricFamily(
                PREFIX + "inputs", "Inputs of players by what became of them.", labels=["fate"]
            )
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
        yield from self._more()


def metrics_page(
    figures: Callable[[], Mapping[str, Any]],
    durations: Callable[[], Mapping[str, Histogram]],
    more: Callable[[], Iterable[Metric]] = tuple,
) -> Callable[[], Page]:
    """Returns a function that makes the page.

    Args:
        figures: returns the figures of `/stats`.
        durations: returns histograms by the name of their metric.
        more: returns further metrics.
    """
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Collector(figures, durations, more))
    ProcessCollector(registry=registry)
    GCCollector(registry=registry)
    return lambda: Page(HTTPStatus.OK, generate_latest(registry), CONTENT_TYPE_PLAIN_0_0_4)
