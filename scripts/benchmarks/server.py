"""The measurements of `bench.py server`: how many clients one server process holds, and the cost of a client.

A number of clients is held if the server's ticks are on time (99 % start less than a tick late) and each client gets at
least 95 % of its snapshots. Players fill the hills from a corner on, at a constant density, so one server can be
measured with several numbers of clients in turn. All times come from one run on one machine, including those of the
echo server.
"""

import contextlib
import http.client
import json
import math
import queue
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from scripts.environment import ROOT
from server.observability.histogram import between
from sovereign_netcode.stderr import Stderr

RATE = 30
PER_SEGMENT = 5
"""Players per segment of 32 x 32 blocks. A client sees nine segments or more, so it sees about 50 players."""
CAPACITY = 2000
SHARE_MIN = 0.95
JOINS_PER_S = 200.0
SETTLE_S = 1.5
"""Seconds after the last join, in which terrain is delivered and caches warm up."""
JOIN_S = 5.0
"""Seconds that the joins may take beyond `clients / JOINS_PER_S`."""
PATIENCE_S = 30.0
START_S = 120.0

ECHO_PICOWS = "echo_picows"
"""Kind of server that shows what another library's sockets would gain."""

Figures = dict[str, Any]


def scene_toml(capacity: int, per_segment: int = PER_SEGMENT, margin: int = 0) -> str:
    """Returns the scene `hills` as TOML, large enough for `capacity` players, with a spawn point for each.

    The spawn points fill one segment after the other.

    Args:
        margin: number of further segments on two sides, without spawn points.
    """
    hills = (ROOT / "shared" / "scenes" / "hills.toml").read_text("utf-8")
    rest = "\n".join(line for line in hills.splitlines() if not line.startswith(("#", "size", "spawns")))
    side = math.ceil(math.sqrt(capacity / per_segment))
    rng = random.Random(1)
    spawns = [
        [32 * x + rng.randrange(1, 31), 32 * y + rng.randrange(1, 31), 27]
        for x, y in sorted(((x, y) for x in range(side) for y in range(side)), key=lambda at: (max(at), at))
        for _ in range(per_segment)
    ]
    return f"tick_rate = {RATE}\nsize = [{side + margin}, {side + margin}, 1]\nspawns = {spawns}\n{rest}\n"


class RigError(Exception):
    """A process of the benchmark has failed. The message says why."""


class Load:
    """A process that generates load (`scripts.loadgen.generator`).

    Args:
        port: port of the server.
        seed: source of the players' chance.
        paths: paths that the players join in turn.
    """

    def __init__(self, port: int, *, seed: int = 1, paths: Sequence[str] = ("/",)) -> None:
        order = {"port": port, "seed": seed, "rate": RATE, "joins_per_s": JOINS_PER_S, "paths": paths}
        self._process, self._errors = _started("scripts.loadgen.generator", json.dumps(order))
        self._said: queue.Queue[Figures] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def hold(self, clients: int) -> bool:
        """Waits until `clients` play and have their terrain. Returns whether all of them play."""
        self.tell(f"clients {clients}")
        deadline, all_play = time.monotonic() + clients / JOINS_PER_S + JOIN_S, False
        while time.monotonic() < deadline and not all_play:
            status = self.next()
            all_play = status.get("playing") == clients == status.get("clients")
        time.sleep(SETTLE_S)
        return all_play

    def tell(self, command: str) -> None:
        """Sends a command of the generator."""
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def next(self) -> Figures:
        """Returns the next figures that the generator reports, or has reported."""
        try:
            return self._said.get(timeout=PATIENCE_S)
        except queue.Empty:
            cause = self._errors.cause(self._process.poll())
            raise RigError(f"the generator of load does not answer: {cause}") from None

    def drain(self) -> Figures:
        """Returns the newest figures that the generator has reported; empty if there are none."""
        status: Figures = {}
        while not self._said.empty():
            status = self._said.get()
        return status

    def stop(self) -> None:
        """Asks the process to end. `close` waits for that."""
        self._process.terminate()

    def close(self) -> None:
        """Ends the process."""
        self.stop()
        _end(self._process)

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with contextlib.suppress(ValueError):  # closed
            for line in self._process.stdout:
                self._said.put(json.loads(line))


class Rig:
    """A server process and a process that generates load.

    Args:
        command: module and arguments of the server.
        seed: source of the players' chance.
        paths: paths that the players join in turn.
    """

    def __init__(self, *command: str, seed: int = 1, paths: Sequence[str] = ("/",)) -> None:
        self._server, errors = _started(*command)
        assert self._server.stdout is not None
        line = self._server.stdout.readline()
        if not line.startswith("listening on "):
            _end(self._server)
            raise RigError(f"the server did not start: {errors.cause(self._server.returncode)}")
        self.port = int(line.rpartition(":")[2])
        self.load = Load(self.port, seed=seed, paths=paths)

    def hold(self, clients: int, seconds: float) -> Figures:
        """Waits until `clients` play, then measures for `seconds`. Returns the counts of both sides."""
        self.load.hold(clients)
        gone = self.load.drain().get("gone", 0)
        before = self.stats()
        self.load.tell("begin")
        time.sleep(seconds)
        self.load.tell("end")
        figures = self.load.next()
        while "seconds" not in figures:
            figures = self.load.next()
        after = self.stats()
        ticks = max(1, after["ticks"] - before["ticks"])
        cpu_s = after["cpu_s"] - before["cpu_s"]
        lateness = between(before["tick_lateness_counts"], after["tick_lateness_counts"])
        expected = RATE * figures["seconds"]
        held = (
            lateness["p99"] < 1e3 / RATE
            and figures["snapshots_worst"] >= SHARE_MIN * expected
            and figures["gone"] == gone
            and figures["clients_in_window"] == clients
        )
        told = {
            "clients": clients,
            "seconds": after["uptime_s"] - before["uptime_s"],
            "held": held,
            "tick_lateness_ms": lateness,
            "ticks_share": ticks / RATE / (after["uptime_s"] - before["uptime_s"]),
            "snapshots_share_worst": figures["snapshots_worst"] / expected,
            "snapshots_share_best": figures["snapshots_best"] / expected,
            "server_cpu_share": cpu_s / (after["uptime_s"] - before["uptime_s"]),
            "cpu_us_per_client_tick": cpu_s * 1e6 / ticks / clients,
            "lost": figures["gone"] - gone,
            "rss_mb": after["rss_mb"],
        }
        if "samples" in after:
            told["samples"] = {name: n - before["samples"][name] for name, n in after["samples"].items()}
        told["entities_in_view"] = after.get("entities_in_view")
        for name in ("inputs_late", "inputs_used", "collections", "collections_cpu_s"):
            if name in after:
                told[name] = after[name] - before[name]
        for name in after:
            if name.endswith("_counts"):
                told[name] = sorted((Counter(dict(after[name])) - Counter(dict(before[name]))).items())
        return told | {f"generator_{name}" if name in ("cpu_share", "late_ms") else name: figures[name] for name in (
            "snapshot_age_ms", "inputs_per_client_per_s", "bytes_down_per_client_per_s", "bytes_up_per_client_per_s",
            "cpu_share", "late_ms",
        )}  # fmt: skip

    def leaving(self, per_s: float) -> None:
        """Makes the oldest clients leave from now on, `per_s` per second, each replaced by a new one."""
        self.load.tell(f"leaving {per_s}")

    def collect(self) -> float:
        """Makes the server collect all its garbage, which not every kind can. Returns the CPU time in seconds."""
        self._server.send_signal(signal.SIGUSR1)
        deadline = time.monotonic() + PATIENCE_S
        while (taken := self.stats()["full_collection_s"]) is None:
            if time.monotonic() > deadline:
                raise RigError(f"the server has not collected its garbage within {PATIENCE_S:g} s")
            time.sleep(0.05)
        return float(taken)

    def stats(self, path: str = "/stats") -> Figures:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        with contextlib.closing(connection):
            connection.request("GET", path)
            return dict(json.loads(connection.getresponse().read()))

    def close(self) -> None:
        self.load.stop()
        self._server.terminate()
        self.load.close()
        _end(self._server)


def _started(module: str, *arguments: str) -> tuple[subprocess.Popen[str], Stderr]:
    command, errors = (sys.executable, "-m", module, *arguments), Stderr()
    try:
        process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors.pipe, text=True
        )
    finally:
        errors.started()
    return process, errors


def _end(process: subprocess.Popen[str]) -> None:
    """Waits at most `PATIENCE_S` for a process to end, then kills it."""
    try:
        process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


@contextlib.contextmanager
def rig(
    kind: str,
    *more: str,
    seed: int = 1,
    capacity: int = CAPACITY,
    per_segment: int = PER_SEGMENT,
    margin: int = 0,
) -> Iterator[Rig]:
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "wide.toml"
        scene.write_text(scene_toml(capacity, per_segment, margin), "utf-8")
        child = [] if kind == ECHO_PICOWS else [kind]
        module = "scripts.benchmarks.echo_picows" if kind == ECHO_PICOWS else "scripts.benchmarks.busy_server"
        running = Rig(module, *child, str(scene), *more, seed=seed)
        try:
            yield running
        finally:
            running.close()


def search(
    running: Rig, first: int, seconds: float, resolution: float, steps: int, report: Callable[[Figures], None]
) -> list[Figures]:
    """Searches for the largest number of clients that is held. Returns the figures of each number that was tried."""
    stages: list[Figures] = []
    good, bad, n = 0, CAPACITY + 1, first
    while len(stages) < steps and n > 10:
        stage = running.hold(n, seconds)
        stages.append(stage)
        report(stage)
        if stage["held"]:
            good = n
            room = min(max(0.97 / stage["server_cpu_share"], 1 + resolution), 2.5)
            n = min(int(n * room), CAPACITY)
            if n >= bad:
                n = (good + bad) // 2
        else:
            bad = n
            n = (good + bad) // 2
        if bad - good <= resolution * good or n == good:
            break
    return stages


def packed(stage: Figures) -> Figures:
    """Adds a crowd's figures under the names of the report. `fairness` is the least served over the best served."""
    return stage | {
        "bytes_per_client_per_s": stage["bytes_down_per_client_per_s"],
        "fairness": stage["snapshots_share_worst"] / max(stage["snapshots_share_best"], 1e-9),
    }


def most(stages: list[Figures]) -> Figures | None:
    """Returns the figures of the largest number of clients that was held; None if none was."""
    return max((stage for stage in stages if stage["held"]), key=lambda stage: stage["clients"], default=None)


def profile(clients: int, seconds: float) -> dict[str, float]:
    """Returns the share of each part in the server's CPU time, by samples of its stack (SIGPROF) in a separate run.

    A signal that arrives while a socket is written or read is handled in the next Python code, mostly in `receive`. So
    the share of `receive` includes the kernel's.
    """
    with rig("profile") as running:
        samples: dict[str, float] = running.hold(clients, seconds)["samples"]
    total = sum(samples.values()) or 1.0
    return {part: n / total for part, n in samples.items()}
