"""The server's process of a soak test, its figures and its log."""

import asyncio
import contextlib
import json
import re
import statistics
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from scripts.environment import ROOT
from sovereign_netcode.loadtest.processes import CannotStartError, stats

SCENE = "hills"
START_S_MAX = 120.0
END_S = 10.0
SAMPLE_S = 1.0
EXPLAINED = re.compile("stalled|suspended|goes on")
"""Pattern of the watchdog's events after a suspension, and on a machine that other processes keep busy."""

Figures = dict[str, Any]


class Life:
    """The server's process. It can be started again, with the same port and directory: a *life* is one run of it."""

    def __init__(self, directory: Path, errors: list[str]) -> None:
        self.directory, self.errors = directory, errors
        self.port = 0
        self.lives = 0
        self.process: asyncio.subprocess.Process | None = None
        self.samples: list[Figures] = []
        """Figures from `/stats` in this life, one per `SAMPLE_S`."""

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    async def start(self) -> None:
        """Starts a new process on the old port.

        Raises:
            CannotStartError: the process did not print that it listens.
        """
        self.lives += 1
        self.samples = []
        command = ("-m", "server", "--host", "127.0.0.1", "--port", str(self.port), "--scene", SCENE)
        flags = ("--data", str(self.directory / "data"), "--log-format", "json", "--checkpoint-s", "20")
        with (self.directory / f"log {self.lives}").open("wb") as log:
            self.process = await asyncio.create_subprocess_exec(
                *(sys.executable, *command, *flags),
                cwd=ROOT,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        assert self.process.stdout is not None
        line = b""
        with contextlib.suppress(TimeoutError):
            line = await asyncio.wait_for(self.process.stdout.readline(), START_S_MAX)
        if not line.startswith(b"listening on "):
            raise CannotStartError(f"the server did not start: {(self.directory / f'log {self.lives}').read_text()}")
        self.port = int(line.rpartition(b":")[2])

    async def end(self, number: int) -> int:
        """Sends a signal, and kills the process if it has not ended after `END_S`. Returns its exit code, or -1."""
        assert self.process is not None
        self.note_faults()
        self.process.send_signal(number)
        with contextlib.suppress(TimeoutError):
            return await asyncio.wait_for(self.process.wait(), END_S)
        self.process.kill()
        await self.process.wait()
        return -1

    def note_faults(self) -> None:
        """Adds the errors that the latest figures count."""
        for name in ("internal_errors", "ticks_failed", "rules_failed"):
            if self.samples and self.samples[-1].get(name):
                self.errors.append(f"life {self.lives}: {name} {self.samples[-1][name]}")

    async def watch(self) -> None:
        """Takes samples until it is cancelled."""
        while True:
            await asyncio.sleep(SAMPLE_S)
            figures = await stats(self.url)
            if figures:
                self.samples.append(figures)

    def rss_growth_mb(self) -> float:
        """Returns the growth in MB from the second quarter of this life's samples to the last quarter."""
        rss, n = [figures["rss_mb"] for figures in self.samples], len(self.samples)
        if n < 8:
            return 0.0
        return round(float(statistics.median(rss[-n // 4 :]) - statistics.median(rss[n // 4 : n // 2])), 2)


def logged(directory: Path) -> tuple[list[str], Counter[str]]:
    """Returns the lines of the logs that are neither information nor explained, and counts of the explained events."""
    bad, explained = [], Counter[str]()
    for path in sorted(directory.glob("log *")):
        for line in path.read_text("utf-8").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                bad.append(f"{path.name}: {line}")
                continue
            if EXPLAINED.search(entry["event"]):
                explained[entry["event"]] += 1
            elif entry["level"] != "info":
                bad.append(f"{path.name}: {line}")
    return bad, explained
