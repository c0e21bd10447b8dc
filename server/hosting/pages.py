"""The pages of many worlds, beside those of the default world.

/worlds               the list of the public worlds, as JSON, for everybody
/worlds/              a page with all worlds, for those who may see private pages; /worlds/live has its figures
/NAME/                the live page of a world; /NAME/live, /NAME/live/N and /NAME/stats are as those at /
"""

import json
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any, TypeVar
from urllib.parse import parse_qs

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from server.hosting.host import WorldHost
from server.hosting.running import RunningWorld
from server.observability.live import HEADERS, html_page
from server.observability.metrics import PREFIX
from server.observability.pages import JSON, Page, PageRequest, line
from server.worlds.worlds import Worlds

F = TypeVar("F", CounterMetricFamily, GaugeMetricFamily)

NAMES_MAX = 16
"""Maximum number of players of a world that are named on the page of all worlds."""
GAUGES = {
    "worlds": "Worlds, besides the default one.",
    "worlds_ticking": "Worlds that tick.",
    "worlds_asleep": "Worlds that have ended and come back when a player joins.",
    "seats_reserved": "Seats that are reserved for players who are on their way.",
    "waiting": "Clients that wait for a match.",
    "lobby_connections": "Connections of clients that ask for a world.",
}
"""Gauges of all worlds together, by the name of the figure in `/stats`, with their help texts."""
WORLD_GAUGES = {
    "players": "Players of a world, including those who may reconnect.",
    "entities": "Entities in a world.",
}
"""Gauges of each world that ticks, by the name of the figure, with their help texts."""
WORLD_COUNTERS = {
    "ticks": "Ticks of a world that have run.",
    "ticks_late": "Ticks of a world that began more than one tick late.",
    "ticks_failed": "Ticks of a world that raised an exception.",
    "ticks_overrun": "Ticks of a world that took longer than the time between two.",
    "skipped_s": "Seconds of dropped ticks of a world.",
    "tick_work_s": "Seconds that the ticks of a world took.",
    "rules_failed": "Exceptions in the rules of a world.",
    "internal_errors": "Exceptions in the server that cost a client, a command or a tick of a world.",
}
"""Counters of each world that ticks, by the name of the figure, with their help texts."""


class WorldPages:
    """The pages of the worlds of a server.

    Args:
        worlds: the worlds.
        host: their host.
        live: whether the pages for browsers are served.
    """

    def __init__(self, worlds: Worlds, host: WorldHost, *, live: bool) -> None:
        self._worlds, self._host, self._live = worlds, host, live
        self._lists: dict[str, tuple[float, Page]] = {}

    def get(self, request: PageRequest) -> Page | None:
        """Returns the answer to a GET request; None: it is for another page."""
        if request.path == "/worlds":
            return self._list(parse_qs(request.query).get("kind", [""])[0])
        first, _, rest = request.path[1:].partition("/")
        running = self._host.running.get(first)
        if first != "worlds" and running is None:
            return None
        if not request.trusted:
            return line(HTTPStatus.FORBIDDEN, f"{request.path}: not allowed for your address")
        if request.path == f"/{first}" and self._live:
            return line(HTTPStatus.FOUND, f"see /{first}/", location=f"/{first}/")
        page = self._index(rest) if running is None else self._of_world(running, rest)
        return page or line(HTTPStatus.NOT_FOUND, f"{request.path}: no such page")

    def _list(self, kind: str) -> Page:
        """Returns the list of the public worlds, all or those of a kind.

        It is made anew ten times per second at most, because everybody may ask for it.
        """
        if kind and kind not in self._worlds.kinds:
            return json_answer({"worlds": []})
        now = self._worlds.now
        if kind not in self._lists or self._lists[kind][0] != now:
            listed = [entry for entry in self._worlds.entries() if kind in ("", entry["kind"])]
            self._lists[kind] = now, json_answer({"worlds": listed})
        return self._lists[kind][1]

    def metrics(self) -> Iterator[Metric]:
        """Yields the metrics of the worlds, and those of each world that ticks, with its name and kind as labels."""
        figures = self._worlds.stats()
        for name, text in GAUGES.items():
            yield GaugeMetricFamily(PREFIX + name, text, figures[name])
        events = CounterMetricFamily(
            PREFIX + "worlds_events", "Worlds and clients by what became of them.", labels=["event"]
        )
        for event, count in figures["worlds_counts"].items():
            events.add_metric([event], count)
        yield events
        ticking = [running for running in self._host.running.values() if running.world.ticking]
        rows = [([running.world.name, running.world.kind.name], running.figures()) for running in ticking]
        labels = ["world", "kind"]
        for name, text in WORLD_GAUGES.items():
            yield _filled(GaugeMetricFamily(f"{PREFIX}world_{name}", text, labels=labels), name, rows)
        for name, text in WORLD_COUNTERS.items():
            yield _filled(CounterMetricFamily(f"{PREFIX}world_{name}", text, labels=labels), name, rows)

    def _index(self, path: str) -> Page | None:
        """Returns a page below `/worlds/`."""
        if path == "" and self._live:
            return html_page("worlds.html")
        return json_answer({"worlds": [*map(_row, self._host.running.values())]}) if path == "live" else None

    def _of_world(self, running: RunningWorld, path: str) -> Page | None:
        """Returns a page below the path of a world."""
        if path == "stats":
            return json_answer(running.stats())
        make = running.live.pages().get(f"/{path}") if self._live else None
        return None if make is None else make()


def json_answer(content: Any, status: int = HTTPStatus.OK) -> Page:
    """Returns a page with JSON."""
    return Page(status, json.dumps(content, separators=(",", ":")).encode() + b"\n", JSON, HEADERS)


def _row(running: RunningWorld) -> dict[str, Any]:
    """Returns the figures of a world for the page of all worlds."""
    ticker, world, game = running.ticker, running.world, running.game
    return {
        "name": world.name,
        "kind": world.kind.name,
        "players": world.players,
        "players_max": world.kind.players_max,
        "private": bool(world.code),
        "locked": world.locked,
        "ticking": world.ticking,
        "properties": world.properties,
        "names": [player.name for player in game.players.values()][:NAMES_MAX],
        "entities": len(game.world),
        "tick_work_ms": ticker.work.quantile_ms(0.99),
        "ticks_overrun": ticker.overruns,
        "failures": running.internal_errors + game.counters.rules_failed,
    }


def _filled(family: F, figure: str, rows: list[tuple[list[str], dict[str, float]]]) -> F:
    """Adds a figure of each world to a metric."""
    for labels, figures in rows:
        family.add_metric(labels, figures[figure])
    return family
