"""The process: its event loop, signals, garbage collection, memory, and a notice on its terminal."""

import asyncio
import contextlib
import gc
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import TextIO

COMPILING = "compiling the physics for this machine, which takes up to some minutes the first time"
"""Notice that is shown while the kernel is compiled."""

logger = logging.getLogger(__name__)


def announce_compiling(stream: TextIO) -> None:
    """Reports that the first start takes longer: on a terminal as plain text, otherwise in the log."""
    if stream.isatty():
        print(f"{COMPILING} ...", file=stream, flush=True)
    else:
        logger.info(COMPILING)


def freeze() -> None:
    """Excludes all present objects from garbage collection; they stay until the end anyway.

    With 200 clients a full collection then takes 3 to 4 ms instead of 53 to 61 ms. Collections of young objects take at
    most 1.2 ms and 0.03 % of a core either way (`scripts/bench.py jitter`); other thresholds did not improve that.
    """
    gc.collect()
    gc.freeze()


def rss_mb() -> float:
    """Returns the memory of this process in RAM, in MB. On other systems than Linux: its peak, or 0 on Windows."""
    try:
        return int(Path("/proc/self/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:  # not Linux
        pass
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def raise_descriptors() -> None:
    """Raises the limit of file descriptors to what the system allows this process: each world takes up to six."""
    try:
        import resource
    except ImportError:  # Windows
        return
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop]:
    """Returns the function that makes the event loop: uvloop's if it is installed, otherwise asyncio's."""
    try:
        import uvloop
    except ImportError:
        return asyncio.new_event_loop
    return uvloop.new_event_loop


def signals() -> list[signal.Signals]:
    """Returns the signals that stop a server: SIGINT, SIGTERM, SIGHUP (its terminal has closed), Ctrl-Break on Windows.

    SIGINT counts even if the parent process made it ignored, as a shell does for background processes of a script. An
    ignored SIGHUP stays ignored, because `nohup` asks for that.
    """
    names = ("SIGINT", "SIGTERM", "SIGBREAK", "SIGHUP")
    there = [signal.Signals(getattr(signal, name)) for name in names if hasattr(signal, name)]
    return [each for each in there if each.name != "SIGHUP" or signal.getsignal(each) is not signal.SIG_IGN]


def leave(number: int, frame: FrameType | None) -> None:
    """Handles a signal before there are clients: ends the process at once, with exit code 0."""
    raise SystemExit(0)


@contextlib.contextmanager
def on_signals(loop: asyncio.AbstractEventLoop, stop: Callable[[str], None]) -> Iterator[None]:
    """Calls `stop` with the name of the first signal. Later signals have their default effect: they end the process."""

    def first(number: signal.Signals) -> None:
        for each in signals():
            signal.signal(each, signal.SIG_DFL)
        stop(number.name)

    for number in signals():
        try:
            loop.add_signal_handler(number, first, number)
        except NotImplementedError:  # Windows
            signal.signal(number, lambda n, _: loop.call_soon_threadsafe(first, signal.Signals(n)))
    yield
