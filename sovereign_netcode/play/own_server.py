"""What the window needs besides: a server of its own, and bots on it. Both end with it."""

import asyncio
import contextlib
import queue
import random
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

from client_sdk.bots import Bot, Wander
from client_sdk.core import Core
from client_sdk.transports.aio import AsyncClient
from client_sdk.transports.connection import ConnectError
from sovereign_netcode.examples.tag_brain import TagPlayer
from sovereign_netcode.stderr import Stderr

START_S = 120.0
"""The first start compiles the physics."""
END_S = 10.0
NAMES = ("Kim", "Lou", "Mio", "Nia", "Oz", "Pia", "Quin", "Rex", "Sol", "Tess", "Uma", "Vic")


@contextlib.contextmanager
def process(*command: str) -> Iterator[tuple[subprocess.Popen[str], Stderr]]:
    """A process of this Python, whose output is read; it is told to end, and made to."""
    errors = Stderr()
    try:
        running = subprocess.Popen(
            [sys.executable, *command], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors.pipe, text=True
        )
    finally:
        errors.started()
    try:
        yield running, errors
    finally:
        running.terminate()
        try:
            running.wait(END_S)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()
        if running.stdout is not None:
            running.stdout.close()


@contextlib.contextmanager
def server(game: str, scene: str | None) -> Iterator[str]:
    """A server on a free port of this machine; its address.

    Raises:
        RuntimeError: it does not start; the text says why.
    """
    options = ["--port", "0", "--game", game, "--log-level", "warning", *(["--scene", scene] if scene else [])]
    with process("-m", "sovereign_netcode.server", *options) as (running, errors):
        lines: queue.Queue[str] = queue.Queue()
        assert running.stdout is not None
        threading.Thread(target=lambda out: lines.put(out.readline()), args=(running.stdout,), daemon=True).start()
        try:
            said: str | None = lines.get(timeout=START_S)
        except queue.Empty:
            said = None
        if said is None or not said.startswith("listening on "):
            code = None if said is None else running.wait(END_S)
            raise RuntimeError(f"the server did not start: {errors.cause(code)}")
        yield said.split()[-1]


@contextlib.contextmanager
def bots(url: str, count: int) -> Iterator[None]:
    """So many bots on a server, in one process."""
    if count == 0:
        yield
        return
    with process("-m", __name__, url, str(count)):
        yield


def policy(seed: int) -> Callable[[Core], None]:
    """Plays tag where that is played, else strolls."""
    tag, stroll = Bot(TagPlayer()), Bot(Wander(random.Random(seed)))
    return lambda core: (tag if core.scene is not None and "it" in core.scene.index_of else stroll)(core)


async def play(url: str, count: int) -> None:
    """Plays until the server ends."""

    async def one(number: int) -> None:
        name = NAMES[number % len(NAMES)]
        client = await AsyncClient.connect(url, name=name, before_update=policy(number))
        async for _ in client:
            pass

    await asyncio.gather(*(one(number) for number in range(count)))


if __name__ == "__main__":
    try:
        asyncio.run(play(sys.argv[1], int(sys.argv[2])))
    except ConnectError as error:
        sys.exit(f"error: the bots cannot play: {error}")
