"""The processes that the window starts: a server, and bots on it. Both end with the window."""

import asyncio
import contextlib
import queue
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence

from client_sdk.async_client import AsyncClient
from client_sdk.bots import Bot, Wander
from client_sdk.transports.common import ConnectError
from server.rules import Rules, load_rules
from sovereign_netcode.stderr import Stderr

START_S = 120.0
"""Seconds in which the server must start. Its first start may compile the physics."""
END_S = 10.0
"""Seconds that a process has to end after SIGTERM. Then it is killed."""
NAMES = ("Kim", "Lou", "Mio", "Nia", "Oz", "Pia", "Quin", "Rex", "Sol", "Tess", "Uma", "Vic")


@contextlib.contextmanager
def process(*command: str) -> Iterator[tuple[subprocess.Popen[str], Stderr]]:
    """Runs a process of this Python within the block. At the end it gets SIGTERM, and is killed after `END_S`."""
    errors, running = Stderr(), None
    try:
        with uninterrupted():
            running = subprocess.Popen(
                [sys.executable, *command],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors.pipe,
                text=True,
            )
            errors.started()
        yield running, errors
    finally:
        if running is not None:
            end(running)


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Holds SIGINT and SIGTERM back, so that no process is started that nobody knows.

    Raises:
        KeyboardInterrupt: one of them has come meanwhile.
    """
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, frame: came.append(number)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        raise KeyboardInterrupt


def end(running: subprocess.Popen[str]) -> None:
    """Ends a process: with SIGTERM, and if that does not do, at once."""
    running.terminate()
    try:
        running.wait(END_S)
    except subprocess.TimeoutExpired:
        running.kill()
        running.wait()
    if running.stdout is not None:
        running.stdout.close()


@contextlib.contextmanager
def server(game: str, scene: str | None, options: Sequence[str] = (), *, reload: bool = False) -> Iterator[str]:
    """Runs a server on a free port of this machine. Yields its URL.

    Args:
        game: the game.
        scene: the scene; None: the game's.
        options: options of the game, each NAME=VALUE.
        reload: whether it restarts when a file beside the game changes.

    Raises:
        RuntimeError: the server did not start. The message says why.
    """
    flags = ["--port", "0", "--game", game, "--log-level", "warning", *(f"--option={option}" for option in options)]
    flags += [*(["--scene", scene] if scene else []), *(["--reload", "true"] if reload else [])]
    with process("-m", "sovereign_netcode.server", *flags) as (running, errors):
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
def bots(url: str, count: int, game: str) -> Iterator[None]:
    """Runs a process of `count` bots that play a game, given as MODULE:CLASS, on a server."""
    if count == 0:
        yield
        return
    with process("-m", __name__, url, str(count), game):
        yield


def policy(rules: Rules, seed: int) -> Bot:
    """Returns a bot that plays a game as its rules say (`Rules.bot_policy`), and wanders otherwise."""
    made = rules.bot_policy(random.Random(seed))
    return Bot(Wander(random.Random(seed)) if made is None else made)


async def play(url: str, count: int, game: str) -> None:
    """Plays a game, given as MODULE:CLASS, with `count` bots until the server ends."""
    rules = load_rules(game)

    async def one(number: int) -> None:
        name = NAMES[number % len(NAMES)]
        policy_ = policy(rules, number)
        client = await AsyncClient.connect(url, name=name, before_update=policy_, behaviours=rules.behaviours)
        async for _ in client:
            pass

    await asyncio.gather(*(one(number) for number in range(count)))


if __name__ == "__main__":
    try:
        asyncio.run(play(sys.argv[1], int(sys.argv[2]), sys.argv[3]))
    except ConnectError as error:
        sys.exit(f"error: the bots cannot play: {error}")
