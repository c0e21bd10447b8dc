"""The processes of a world on many processes, and a server in one process, while players wander.

All processes run all the time. The players are in one of the two worlds at a time, and their numbers take turns.
Another process generates them, without prediction and world. The CPU time of a process is read from its clock in the
system (Linux), all its threads and the kernel's work for it included; the process itself does not notice.
"""

import asyncio
import time
from pathlib import Path
from typing import Any

from scripts.benchmarks.server import RATE, Load, RigError, scene_toml
from scripts.scale_lab.cluster import Cluster, PartProcess
from server.observability.histogram import between

LIMITS = "[limits]\nresume_s = 0\n"
"""Settings of all processes: a player whose connection ends is gone at once."""
PATIENT = ("--takeover-s", "10")
"""Arguments of the parts: on a busy machine, the standby does not take over during the measurement."""
COUNTED = {"edge": ("bus_bytes_out", "batches_late"), "sequencer": ("tick", "bus_bytes_out")}
"""Figures of the parts that grow."""
PROCESSES = ("server", "edge", "sequencer", "standby", "bus")
LATE_SHARE = 0.02
"""Share of late batches beyond which a measurement is not calm: the machine was too busy, and clients of an edge cost
much more while their inputs are late."""
WINDOW_S = 1.0
"""Seconds of one measurement."""


def cpu_s(pid: int) -> float:
    """Returns the CPU time of a process so far, in seconds."""
    clock = ~pid << 3 | 2  # as clock_getcpuclockid of Linux
    return time.clock_gettime(clock)


class Processes:
    """A server in one process and the parts of a world, each with its generator of players.

    Args:
        folder: an existing folder for all files.
        capacity: number of players for whom the scene has spawn points.
    """

    def __init__(self, folder: Path, capacity: int) -> None:
        (folder / "hills.toml").write_text(scene_toml(capacity), "utf-8")
        (folder / "server.toml").write_text(f'scene = "{folder / "hills.toml"}"\n{LIMITS}', "utf-8")
        arguments = ("--config", str(folder / "server.toml"))
        self.server = PartProcess(folder, "server", arguments)
        self.cluster = Cluster(folder, edges=1, standbys=1, arguments=(*arguments, *PATIENT))
        self._loads: dict[str, Load] = {}

    async def __aenter__(self) -> "Processes":
        try:
            self.server.start()
            await self.cluster.start()
            await self.server.ready()
            for part in (self.server, self.cluster.edges[0]):
                self._loads[part.name] = Load(part.port)
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *error: object) -> None:
        for load in self._loads.values():
            load.close()
        self.cluster.close()
        self.server.kill()

    async def measured(self, players: int, seconds: float, where: str) -> tuple[list[dict[str, float]], dict[str, Any]]:
        """Lets players wander in one of the two worlds.

        Args:
            players: the number of players.
            seconds: how long.
            where: "server" or "edge1".

        Returns:
            The CPU time of each process in microseconds per tick, by its name, in each window, and whether hardly any
            batches were late then (`calm`); and the figures of the world on many processes during all of them.

        Raises:
            RigError: the players do not play in time.
        """
        load, cluster = self._loads[where], self.cluster
        if not await asyncio.to_thread(load.hold, players):
            raise RigError(f"{players} players do not play in time")
        pids = {"server": self.server.pid}
        if where != "server":
            pids = {"edge": cluster.edges[0].pid, "sequencer": cluster.sequencer.pid}
            pids |= {"standby": cluster.standbys[0].pid, "bus": cluster.nats.pid}
        before, windows = await self._figures(), []
        for _ in range(max(round(seconds / WINDOW_S), 1)):
            began, spent = time.monotonic(), {name: cpu_s(pid) for name, pid in pids.items()}
            await asyncio.sleep(WINDOW_S)
            ticks = (time.monotonic() - began) * RATE
            window = {name: 1e6 * (cpu_s(pid) - spent[name]) / ticks for name, pid in pids.items()}
            windows.append({"players": players, **window})
        bus = _between(before, await self._figures())
        await asyncio.to_thread(load.hold, 0)
        calm = where == "server" or bus["batches_late"] <= LATE_SHARE * bus["ticks"]
        return [window | {"calm": calm} for window in windows], {"players": players, **bus}

    async def _figures(self) -> dict[str, Any]:
        figures = {part.role: await part.stats() for part in (self.cluster.edges[0], self.cluster.sequencer)}
        for role, found in figures.items():
            if not found:
                raise RigError(f"the {role} does not answer")
        return figures


def _between(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Returns the figures of the world on many processes between two moments."""
    edge, sequencer = ({k: after[part][k] - before[part][k] for k in COUNTED[part]} for part in COUNTED)
    trips = between(before["edge"]["bus_round_trip_counts"], after["edge"]["bus_round_trip_counts"])
    return {
        "ticks": sequencer["tick"],
        "log_bytes": sequencer["bus_bytes_out"] / max(sequencer["tick"], 1),
        "batch_bytes": edge["bus_bytes_out"] / max(sequencer["tick"], 1),
        "batches_late": edge["batches_late"],
        "bus_round_trip_ms": trips,
        "edge_lead_ms": after["edge"]["edge_lead_ms"],
    }
