"""What a server process asks of its interpreter and its system: an event loop, signals, memory, a terminal."""

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

COMPILING = "compiling the physics for this machine, which takes 5 to 20 s the first time"

logger = logging.getLogger(__name__)


def announce_compiling(stream: TextIO) -> None:
    """Says why the first start takes long: on a terminal as plain text, else in the log."""
    if stream.isatty():
        print(f"{COMPILING} ...", file=stream, flush=True)
    else:
        logger.info(COMPILING)


def freeze() -> None:
    """Takes everything that exists by now out of the garbage collector's rounds: it stays until the end anyway.

    With 200 clients a full collection takes 3 to 4 ms then instead of 53 to 61; the young ones are 1.2 ms at most and
    0.03 % of a core either way (`scripts/bench.py jitter`), for which other thresholds gained nothing.
    """
    gc.collect()
    gc.freeze()


def rss_mb() -> float:
    """Memory of this process that is in RAM, in MB; where the system does not say, the most it ever was, or 0."""
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


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop]:
    """What makes the event loop: uvloop where it is installed."""
    try:
        import uvloop
    except ImportError:
        return asyncio.new_event_loop
    return uvloop.new_event_loop


def signals() -> list[signal.Signals]:
    """The signals that end a server: SIGINT, SIGTERM, Ctrl-Break on Windows, and SIGHUP (its terminal has closed).

    SIGINT counts even where the starter had it ignored, as a shell does for what a script starts in the background. An
    ignored SIGHUP stays ignored: that is what `nohup` is for.
    """
    names = ("SIGINT", "SIGTERM", "SIGBREAK", "SIGHUP")
    there = [signal.Signals(getattr(signal, name)) for name in names if hasattr(signal, name)]
    return [each for each in there if each.name != "SIGHUP" or signal.getsignal(each) is not signal.SIG_IGN]


def leave(number: int, frame: FrameType | None) -> None:
    """Before there are clients, nobody has to be told."""
    raise SystemExit(0)


@contextlib.contextmanager
def on_signals(loop: asyncio.AbstractEventLoop, stop: Callable[[str], None]) -> Iterator[None]:
    """Calls `stop(name)` for the first signal; from then on signals do what they do by default: end at once."""

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
