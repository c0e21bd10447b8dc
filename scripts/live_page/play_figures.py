"""Measures what the page /play costs in a browser: CPU time of its worker, so that other programs matter little.

    python -m scripts.live_page.play_figures URL [--seconds 20]      on Linux; a server with the game runs at URL

Prints one line of JSON: the CPU time until the player has joined, per frame and per predicted tick, and the memory.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

from scripts.live_page.chromium import Tab, chromium, installed

JOIN_S = 240.0
WORKER = "DedicatedWorker"
"""Beginning of the name of a worker's thread in Chromium."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url", help="address of the server, like http://127.0.0.1:8765")
    parser.add_argument("--seconds", type=float, default=20.0, help="time to measure (default: %(default)g)")
    args = parser.parse_args()
    browser = installed()
    if browser is None:
        print("error: there is no Chromium on this machine")
        return 1
    before = threads()
    with chromium(browser) as tab:
        tab.open(f"{args.url}/play?name=Ann", 1200, 760)
        tab.until("globalThis.play?.view?.me", JOIN_S)
        own = max(threads().keys() - before.keys(), key=cpu_s)
        print(json.dumps(measured(tab, own, args.seconds)))
    return 0


def measured(tab: Tab, worker: Path, seconds: float) -> dict[str, Any]:
    """Returns the figures of a page that has joined.

    Args:
        tab: the page.
        worker: the thread of its worker.
        seconds: time to measure.
    """
    joined_s = cpu_s(worker)
    tab.run("globalThis.drawn = 0; play.client.addEventListener('frame', () => { drawn++; })")
    started, cpu, stats = time.monotonic(), cpu_s(worker), tab.run("play.client.stats")
    time.sleep(seconds)
    spent, wall, now = cpu_s(worker) - cpu, time.monotonic() - started, tab.run("play.client.stats")
    frames = tab.run("drawn")
    ticks = now["tick"] - stats["tick"] + now["replayed_ticks"] - stats["replayed_ticks"]
    return {
        "joined_cpu_s": round(joined_s, 2),
        "memory_mb": round(tab.run("play.client.started.memory") / 1e6, 1),
        "frames_per_s": round(frames / wall, 1),
        "cpu_share": round(spent / wall, 3),
        "frame_cpu_ms": round(1000 * spent / max(frames, 1), 2),
        "predicted_ticks_per_s": round(ticks / wall),
        "cpu_ms_per_predicted_tick": round(1000 * spent / max(ticks, 1), 2),
        "corrections": now["corrections"],
        "divergences": now["divergences"],
    }


def threads() -> dict[Path, str]:
    """Returns the threads of all workers, with their names."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/task/[0-9]*"):
        try:
            name = (path / "comm").read_text("utf-8")
        except OSError:  # it has ended
            continue
        if name.startswith(WORKER):
            found[path] = name
    return found


def cpu_s(thread: Path) -> float:
    """Returns the CPU time of a thread in seconds."""
    user, system = (thread / "stat").read_text("utf-8").rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    raise SystemExit(main())
