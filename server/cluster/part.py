"""The basis of the parts of a world: a process with a replica that follows the log, and its figures."""

import time
from collections.abc import Callable
from typing import Any

from server.cluster.bus import Bus
from server.cluster.following import Following
from server.journal.recorded_world import RecordedWorld
from server.observability.errors import FaultReporter
from server.observability.histogram import Histogram
from server.players.persisted_state import PersistedState
from server.players.player import Player
from shared.scene import Scene

SILENT_S = 1.0
"""Seconds without a record after which a part is not ready."""


class PartError(Exception):
    """A reason for which a part ends. It may be started again."""


class Part:
    """One part of a world, in an event loop.

    Args:
        bus: its bus.
        fresh: a new world of the scene with its terrain.
        name: name of the part, which no other part of the world has had.
        world: name of the world.
    """

    def __init__(self, bus: Bus, fresh: RecordedWorld, *, name: str, world: str) -> None:
        self.bus, self.name, self.world_name = bus, name, world
        self.scene: Scene = fresh.scene
        self.following = Following(bus, fresh)
        self.faults = FaultReporter()
        self.lateness, self.work = Histogram(), Histogram()
        self.ticks = 0
        self.latest = -1e9
        """Time in seconds of the newest tick."""
        self.began: Callable[[], object] = lambda: None
        """Function that is called once the replica has caught up."""

    @property
    def world(self) -> RecordedWorld:
        """The world of the part's replica."""
        return self.following.replica.world

    @property
    def kept(self) -> PersistedState:
        """The persisted state of the world."""
        return self.following.replica.kept

    @property
    def players(self) -> dict[int, Player]:
        """All players of the world by entity."""
        return self.kept.players

    def shut_down(self, reason: str, wait: float) -> None:
        """Closes the connections of all clients, if the part has any. Arguments as for `Game.shut_down`."""

    def open(self, link: Any, now: float) -> Any:
        """Handles an open WebSocket. Only an edge has any."""
        raise NotImplementedError

    def receive(self, session: Any, data: bytes, now: float) -> None:
        """Handles one message of a client. Only an edge has any."""
        raise NotImplementedError

    def lost(self, session: Any, now: float) -> None:
        """Handles the end of a WebSocket. Only an edge has any."""
        raise NotImplementedError

    def unready(self) -> str:
        """Returns the reason why the part does not do its work; empty if it does."""
        following = self.following
        if following.reader is None or following.seq < following.target:
            return f"catching up: record {following.seq} of {following.target}"
        age = time.monotonic() - self.latest
        return "no record for more than a second" if age > SILENT_S else ""

    def stats(self) -> dict[str, Any]:
        """Returns the figures of the part."""
        return {
            "part": self.name,
            "tick": self.world.tick,
            "tick_rate": self.scene.tick_rate,
            "players": len(self.players),
            "entities": len(self.world),
            "segments": len(self.world.blocks.rows),
            "epoch": self.following.replica.epoch,
            "log_seq": self.following.seq,
            "bus_bytes_out": self.bus.bytes_out,
            "bus_bytes_in": self.bus.bytes_in,
            "ticks": self.ticks,
            "tick_work_ms": self.work.summary(),
        }

    async def run(self) -> None:
        """Does the work of the part until it is cancelled.

        Raises:
            PartError: the part has to end.
        """
        raise NotImplementedError

    async def leave(self) -> None:
        """Notes on the bus that the part is about to end."""

    def stop(self) -> None:
        """Ends the work of the part."""
        self.following.close()
