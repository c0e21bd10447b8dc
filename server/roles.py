"""The roles of `sovereign-server`: one part of a world on many processes, with the pages and signals of a server."""

import asyncio
import contextlib
import secrets
from collections.abc import Callable, Iterator
from typing import Any

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from server.cluster.bus import BusError
from server.cluster.edge import EdgePart
from server.cluster.identity import IdentityError, identity_of, join_world
from server.cluster.part import Part, PartError
from server.cluster.sequencer import SequencerPart
from server.config.options import SettingsError
from server.config.settings import Settings
from server.extras import install
from server.journal.recorded_world import RecordedWorld
from server.net.addresses import bracketed, reachable
from server.net.gateway import Events
from server.observability.histogram import Histogram
from server.observability.metrics import PREFIX
from server.observability.pages import Page, line
from server.play.play import PlayPages, play_pages
from server.rules import Rules
from server.runtime.event_loop import freeze, loop_factory
from server.runtime.keeping import recorded
from server.runtime.structured import structlog
from server.runtime.tasks import Tasks
from server.serving import Serving
from shared.scene import Scene

LEAVE_S = 12.0
"""Seconds that the shutdown waits until the clients have gone on at other edges."""

PART_GAUGES = {
    "epoch": "Epoch of the newest record.",
    "log_seq": "Sequence number of the newest record that the part has.",
    "leads": "1 if the part is the sequencer now, otherwise 0.",
    "unacknowledged": "Records that the log has not acknowledged.",
    "takeover_ms": "Length of the pause that ended with this part's takeover, in milliseconds.",
    "edge_lead_ms": "Time by which an edge takes inputs ahead of the sequencer, in milliseconds.",
}
"""Gauges of the parts by the name of the figure in `/stats`, with their help texts. A part has those of its role."""
PART_COUNTERS = {
    "bus_bytes_in": "Bytes of batches and records received.",
    "bus_bytes_out": "Bytes of batches and records sent.",
    "checkpoints": "Checkpoints saved.",
    "repeated": "Records sent again.",
    "ticks_still": "Ticks that were left out because the log did not answer.",
    "batches_late": "Records that lacked the batch of this edge.",
    "sheds": "Times that this edge sent its clients away because it was behind.",
    "handovers_asked": "Clients that were asked to go on at another edge.",
}
"""Counters of the parts by the name of the figure in `/stats`, with their help texts."""

logger = structlog.stdlib.get_logger("server")


class PartServer(Serving):
    """A server of one part.

    Args:
        settings: the settings.
        part: the part.
        play: the page to play on, of an edge; None: there is none.
    """

    def __init__(self, settings: Settings, part: Part, play: PlayPages | None = None) -> None:
        self.part = part
        self._files = contextlib.ExitStack()
        self._work: asyncio.Task[None] | None = None
        super().__init__(settings, part, routes=True, play=play)

    def _begin(self, loop: asyncio.AbstractEventLoop, tasks: Tasks, port: int) -> None:
        settings, part = self.settings, self.part
        if settings.record is not None:
            path = settings.record
            part.began = lambda: self._files.enter_context(recorded(part.scene, path, part.world))
        if isinstance(part, EdgePart):
            secure = "" if settings.tls_cert is None else "s"
            part.url = settings.public_url or f"ws{secure}://{bracketed(reachable(settings.host))}:{port}"
        freeze()
        self._work = loop.create_task(part.run())
        self._work.add_done_callback(self._worked)

    def _worked(self, work: asyncio.Task[None]) -> None:
        """Ends the server if the part has ended."""
        error = None if work.cancelled() else work.exception()
        if error is not None:
            expected = isinstance(error, PartError | BusError)
            logger.error("the part has ended", reason=str(error), exc_info=None if expected else error)
            self._end(str(error) or type(error).__name__, 1)

    async def _drain(self) -> None:
        self.draining = True
        with contextlib.suppress(BusError, TimeoutError):
            await asyncio.wait_for(self.part.leave(), LEAVE_S)
        await super()._drain()

    def _end_work(self) -> None:
        self.part.stop()
        if self._work is not None:
            self._work.cancel()

    def _close(self) -> None:
        self._files.close()

    def unready(self) -> str:
        return "draining" if self.draining else self.part.unready()

    def _durations(self) -> dict[str, Histogram]:
        return {"tick_lateness_seconds": self.part.lateness, "tick_work_seconds": self.part.work}

    def _metrics(self) -> Iterator[Metric]:
        figures = self.part.stats()
        part = GaugeMetricFamily(PREFIX + "part", "1: a part with this role runs.", labels=["role", "world"])
        part.add_metric([self.settings.role, self.settings.world], 1)
        yield part
        for name, text in PART_GAUGES.items():
            if name in figures:
                yield GaugeMetricFamily(PREFIX + name, text, figures[name])
        for name, text in PART_COUNTERS.items():
            if name in figures:
                yield CounterMetricFamily(PREFIX + name, text, figures[name])

    def _route(self, target: str, address: str) -> Events | Page:
        part = self.part
        if not isinstance(part, EdgePart):
            return line(404, f"this is a {self.settings.role}, which has no clients; connect to an edge")
        why = part.unready()
        return line(503, why, retry_after="1") if why or part.core is None else part


def run_part(
    settings: Settings,
    scene: Scene,
    rules: Rules,
    world: RecordedWorld,
    authenticate: Callable[[str], str] | None,
) -> int:
    """Runs one part until a signal. Returns the exit code.

    Args:
        settings: the settings.
        scene: the scene.
        rules: the rules; an edge runs nothing of them but `load_player`.
        world: a new world of the scene with its terrain.
        authenticate: returns the subject of a client's token, as for `Game`.

    Raises:
        SettingsError: the bus cannot be used, or the part belongs to another world than the one on the bus.
    """
    with asyncio.Runner(loop_factory=loop_factory()) as runner:
        return runner.run(_run(settings, scene, rules, world, authenticate))


async def _run(
    settings: Settings,
    scene: Scene,
    rules: Rules,
    world: RecordedWorld,
    authenticate: Callable[[str], str] | None,
) -> int:
    try:
        from server.cluster.nats_bus import NatsBus
    except ModuleNotFoundError as error:
        raise SettingsError(f"role = {settings.role!r}: needs {error.name}: {install('scale')}") from error
    assert settings.bus is not None
    identity = identity_of(scene, seed=settings.seed, game=settings.game or "", options=settings.options)
    name = f"{settings.role}-{secrets.token_hex(4)}"
    try:
        bus = await NatsBus.connect(settings.bus, settings.world, replicas=settings.bus_replicas)
        try:
            await join_world(bus, settings.world, identity)
            common: dict[str, Any] = {"name": name, "world": settings.world, "limits": settings.limits}
            part: Part
            play: PlayPages | None = None
            if settings.role == "edge":
                part = EdgePart(bus, world, authenticate=authenticate, rules=rules, **common)
                play = play_pages(settings, [(settings.game or scene.name, scene, rules)])
            else:
                part = SequencerPart(
                    bus,
                    world,
                    rules=rules,
                    seed=settings.seed,
                    begins=settings.role == "sequencer",
                    checkpoint_s=settings.checkpoint_s,
                    takeover_s=settings.takeover_s,
                    **common,
                )
                if settings.durability == "power":
                    logger.info("an edit survives a power cut only if the bus has sync_interval: always")
            return await PartServer(settings, part, play).serve()
        finally:
            await bus.close()
    except (BusError, IdentityError) as error:
        raise SettingsError(str(error)) from error
