#!/usr/bin/env python3
"""Compares lead controllers: late inputs against added latency, per link, in simulated time.

A trial has no physics. It consists of a server that ticks, a client whose clock drifts and starts at a random time,
pings, one input per tick to the server, one snapshot per tick to the client with the arrival margins, and the
controller. Its *oracle* is the least constant lead that would have had the same share of late inputs, computed from the
run's own arrival times.

    added latency   mean lead of an input over the server's true time when it was made, minus half the round trip
    fair            only inputs for which a controller could prepare: not those made during a spike or the 250 ms after
                    it, or in a dip's first second
    above           latency added beyond the oracle, over the fair inputs
    it needs        latency that the other controller would add at our late share, with its best setting for this run
    ours then       latency that ours would add at the other's late share, with its best setting for this run
    front           no other controller has both fewer late inputs and less latency

Our controller is compared at its default setting, which is the same on every link. A setting chosen from the run that
it is judged by is better than any that is possible in practice, so both columns favour the controller that is set. With
`--seeds`, the latency that a rule needs at our late share is compared with ours on each run, because one run of ten
minutes decides it only to within a few ms.
"""

import argparse
import heapq
import json
import math
import random
import statistics
import sys
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from itertools import count
from pathlib import Path as File
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from client_sdk.netsim.links import PRESETS, Weather, Wire
from client_sdk.timing.clock import PRICE_S, SAFETY_S, STALL_S, LeadController, PricedLead, ServerClock, Timeline
from scripts.controllers import RIVALS, Rival

RATE = 32
TICK_MS = 1000 / RATE
INPUT_BYTES, PING_BYTES, SNAPSHOT_BYTES = 16, 12, 400
GATE_BYTES = 1448
DRIFT = 200e-6
AFTER_SPIKE_S = 0.25
AFTER_DIP_S = 1.0
TIE_MS = 0.1 * TICK_MS
OURS = "ours"
BOUNDS = {"lan": 0.005, "regional": 0.005, "typical": 0.01, "far": 0.02, "wifi": 0.02, "dip": 0.01}
"""Largest share of late inputs, among the fair ones, that each preset allows."""
SHARE_MAX = 0.5
"""Share of late inputs from which a controller is not compared, because it does not try to be on time."""
LONG_S = 4.0
"""Longest stall, in seconds, as a setting of our controller with which it treats the presets' spikes as stalls."""
SEARCH = 8
"""Trials per search for another controller's setting."""

Row = dict[str, Any]


class Trial:
    """One controller on one link.

    Args:
        preset: a name in `client_sdk.netsim.links.PRESETS`.
        lead: the controller; a `Rival` also gets the results of pings and the ticks of snapshots.
        seed: source of everything random, which does not depend on the controller.
    """

    def __init__(self, preset: str, lead: LeadController, seed: int) -> None:
        rng = random.Random(seed)
        self.now = 0.0
        self.lead = lead
        self.weather = Weather(PRESETS[preset], rng.getrandbits(32))
        self.leads: dict[int, float] = {}
        """Lead of each tick's input over the server's true time when it was made, in ticks."""
        self.margins: dict[int, float] = {}
        """Arrival margin of each tick's input, in ticks."""
        self.made: dict[int, float] = {}
        """Time at which each tick's input was made."""
        self._rival = lead if isinstance(lead, Rival) else None
        self._drift = rng.uniform(-DRIFT, DRIFT)
        self._clock_start = rng.uniform(0, 1e5)
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._number = count()
        self._up = Wire(self, self.weather, rng.getrandbits(32), self._at_server)
        self._down = Wire(self, self.weather, rng.getrandbits(32), self._at_client)
        self._going_up: deque[tuple[int, float]] = deque()  # first tick or -1, sent
        self._going_down: deque[tuple[int, Any]] = deque()  # tick or -1, margins or the ping's answer
        self._told: list[tuple[int, float]] = []
        self._tick = -1
        self._clock = ServerClock()
        self._clock.rate = float(RATE)
        self._timeline: Timeline | None = None
        self._newest = -1
        self._phases: dict[int, float] = {}
        self._pings = 0
        self._next_ping = 0.0

    def at(self, when: float, act: Callable[[], None]) -> None:
        """Schedules a call for a time (`client_sdk.netsim.links.Scheduler`)."""
        heapq.heappush(self._queue, (when, next(self._number), act))

    def run(self, seconds: float) -> None:
        """Runs the trial, from connecting on."""
        self._server()
        self._client()
        queue = self._queue
        while queue[0][0] <= seconds:
            self.now, _, act = heapq.heappop(queue)
            act()

    @property
    def _local(self) -> float:
        return self._clock_start + self.now * (1 + self._drift)

    # -- the server ----------------------------------------------------------------------------------------

    def _server(self) -> None:
        self._tick += 1
        self.at((self._tick + 1) / RATE, self._server)
        if self._down.outstanding() <= GATE_BYTES:
            self._going_down.append((self._tick, self._told))
            self._down.send(bytes(SNAPSHOT_BYTES + 2 * len(self._told)))
            self._told = []

    def _at_server(self, message: bytes) -> None:
        tick, sent = self._going_up.popleft()
        if tick < 0:
            self._going_down.append((-1, (sent, self.now * RATE)))
            self._down.send(bytes(PING_BYTES))
            return
        margin = tick - self.now * RATE
        self.margins[tick] = margin
        self._told.append((tick, margin))

    # -- the client ----------------------------------------------------------------------------------------

    def _at_client(self, message: bytes) -> None:
        tick, content = self._going_down.popleft()
        now = self._local
        if tick < 0:
            sent, answer = content
            self._clock.answered(sent, answer, now)
            if self._rival:
                self._rival.answered(now - sent, answer - RATE * (sent + now) / 2, now)
            return
        for at, margin in content:
            self.lead.observe(at, margin, self._phases.pop(at), now)
        if self._rival:
            self._rival.heard(tick, now)

    def _client(self) -> None:
        now, timeline = self._local, self._timeline
        if now >= self._next_ping:
            self._pings += 1
            self._next_ping = now + (0.1 if self._pings < 5 else self._rival.ping_s if self._rival else 1.0)
            self._going_up.append((-1, now))
            self._up.send(bytes(PING_BYTES))
        due = self._next_ping
        if timeline is None and self._clock.ready:
            timeline = self._timeline = Timeline(RATE, self.lead.start(self._clock, now), now)
            self._newest = math.floor(timeline.tick(now))
        if timeline is not None:
            if timeline.steer(self.lead, self._clock, now):
                self._newest = max(self._newest, math.floor(timeline.tick(now)) - 1)
            to = math.floor(timeline.tick(now))
            while self._newest < to:
                self._newest += 1
                self._make(self._newest, timeline.phase)
            due = min(due, timeline.when(self._newest + 1))
        else:
            due = min(due, now + 0.01)
        self.at(self.now + max(due - now, 1e-4) / (1 + self._drift), self._client)

    def _make(self, tick: int, phase: float) -> None:
        self._phases[tick] = phase
        self.made[tick] = self.now
        self.leads[tick] = tick - self.now * RATE
        self._going_up.append((tick, 0.0))
        self._up.send(bytes(INPUT_BYTES))

    # -- results -------------------------------------------------------------------------------------------

    def fair(self, tick: int) -> bool:
        """Returns whether a tick's input was made outside of spikes and the start of a dip."""
        made, weather = self.made[tick], self.weather
        if 0 <= weather.dipped(made) < AFTER_DIP_S:
            return False
        return not any(begin - 2 * weather.path.rtt_s <= made < end + AFTER_SPIKE_S for begin, end, _ in weather.spikes)

    def figures(self, ticks: Iterable[int]) -> tuple[float, float, float, float]:
        """Returns the late share of these inputs, and in ticks the mean and p99 of added latency, and the oracle's."""
        leads, needs, late = [], [], 0
        for tick in ticks:
            leads.append(self.leads[tick])
            needs.append(self.leads[tick] - self.margins[tick])
            late += self.margins[tick] < 0
        if not leads:
            return 0.0, 0.0, 0.0, 0.0
        leads.sort()
        needs.sort()
        half = self.weather.path.rtt_s / 2 * RATE
        oracle = needs[max(len(needs) - 1 - late, 0)]
        mean, p99 = sum(leads) / len(leads), leads[int(0.99 * len(leads))]
        return late / len(leads), mean - half, p99 - half, oracle - half

    def row(self, preset: str, controller: str, seed: int) -> Row:
        """Returns the trial's row of the table. Latencies are in ms."""
        known = sorted(self.margins)
        share, mean, p99, oracle = self.figures(known)
        fair_share, fair_mean, _, fair_oracle = self.figures(filter(self.fair, known))
        skipped = known[-1] - known[0] + 1 - len(known)
        return {
            "preset": preset,
            "controller": controller,
            "seed": seed,
            "inputs": len(known),
            "skipped": skipped,
            "late_inputs_share": (share * len(known) + skipped) / (len(known) + skipped),
            "added_latency_ms": mean * TICK_MS,
            "added_latency_p99_ms": p99 * TICK_MS,
            "oracle_latency_ms": oracle * TICK_MS,
            "fair_late_share": fair_share,
            "fair_latency_ms": fair_mean * TICK_MS,
            "fair_oracle_ms": fair_oracle * TICK_MS,
        }


def trial(preset: str, controller: str, minutes: float, seed: int, setting: tuple[float, ...] = ()) -> Row:
    """Runs a controller by name. `setting` has arguments for `PricedLead`, or for a `Rival` after its rate."""
    lead: LeadController = PricedLead(*setting) if controller == OURS else RIVALS[controller](RATE, *setting)
    run = Trial(preset, lead, seed)
    run.run(60 * minutes)
    return run.row(preset, controller, seed)


def run(preset: str, minutes: float, seed: int) -> list[Row]:
    """Runs every controller on one link. Returns the rows of `Trial.row`, ours first, and in each further

    its_latency_ms      latency that it would add at our late share; None: it cannot reach it, or has no setting
    first               ours adds less than that, or the same within `TIE_MS`
    equal_latency_ms    latency that ours would add at its late share; None beyond the curve
    beaten              ours adds less at that share, or the same within `TIE_MS`
    on_front            no other controller has both fewer late inputs and less latency
    """
    rows = [trial(preset, name, minutes, seed) for name in (OURS, *RIVALS)]
    ours = rows[0]
    points = [point(ours)] + [point(trial(preset, OURS, minutes, seed, setting)) for setting in settings(preset)]
    for row in rows:
        late, added = point(row)
        its = added if row is ours else set_to(row, ours, minutes)
        equal = curve(points, late)
        row["its_latency_ms"] = its
        row["first"] = its is None or ours["added_latency_ms"] <= its + TIE_MS
        row["equal_latency_ms"] = equal
        row["beaten"] = equal is not None and equal <= added + TIE_MS
        row["on_front"] = not any(
            other is not row and all(a <= b for a, b in zip(point(other), (late, added), strict=True)) for other in rows
        )
    return rows


def set_to(row: Row, ours: Row, minutes: float) -> float | None:
    """Returns the latency that another controller adds with the least safety at which it is no later than ours.

    It may switch between two settings (`curve`). None: no setting reaches our late share.
    """
    best: list[float] = []
    for spread in RIVALS[row["controller"]].spreads:
        points = [point(row)]
        least = -row["added_latency_ms"] / TICK_MS
        most = least + 2 * ours["added_latency_ms"] / TICK_MS + 2.0
        for _ in range(SEARCH):
            more = (least + most) / 2
            points.append(point(trial(row["preset"], row["controller"], minutes, row["seed"], (more, spread))))
            least, most = (least, more) if points[-1][0] <= ours["late_inputs_share"] else (more, most)
        found = curve(points, ours["late_inputs_share"])
        best += [] if found is None else [found]
    return min(best, default=None)


def settings(preset: str) -> list[tuple[float, float, float]]:
    """Returns settings to try ours with: price, safety and longest stall in seconds, from careless to careful."""
    ticks = [(price, SAFETY_S * RATE) for price in (3.0, 10.0, 30.0, 80.0, 600.0, 2000.0)]
    ticks += [(PRICE_S * RATE, 0.08), (PRICE_S * RATE, 0.15)]
    ticks += [(2000.0, safety) for safety in (0.3, 0.6, 1.0, 1.5, 2.0)]
    found = [(price / RATE, safety / RATE) for price, safety in ticks]
    stalls = (STALL_S, LONG_S) if PRESETS[preset].spike else (STALL_S,)
    return [(*one, stall_s) for one in found for stall_s in stalls]


def curve(points: list[tuple[float, float]], late: float) -> float | None:
    """Returns the least latency at a late share, where a controller may switch between the settings of two points."""
    under = [point for point in points if point[0] <= late]
    over = [point for point in points if point[0] > late]
    between = [a + (b - a) * (late - x) / (y - x) for x, a in under for y, b in over]
    if not under or late >= SHARE_MAX:
        return None
    return min([*between, *(added for _, added in under)])


def point(row: Row) -> tuple[float, float]:
    """Returns the late share and the added latency of a row."""
    return row["late_inputs_share"], row["added_latency_ms"]


def table(rows: list[Row]) -> Table:
    """Returns the rows of `run` as a table for people. Latencies are in ms."""
    result = Table(title="Lead controllers: late inputs against added latency (ms)", box=box.SIMPLE_HEAD)
    for column in ("preset", "controller"):
        result.add_column(column, no_wrap=True)
    for column in ("late %", "added", "p99", "oracle", "it needs", "ours then", "fair %", "above", "front"):
        result.add_column(column, justify="right", no_wrap=True)
    preset = ""
    for row in rows:
        if preset != row["preset"]:
            result.add_section()
        its, equal, ours = row["its_latency_ms"], row["equal_latency_ms"], row["controller"] == OURS
        result.add_row(
            "" if preset == row["preset"] else row["preset"],
            row["controller"],
            f"{100 * row['late_inputs_share']:.2f}",
            *(f"{row[name]:.1f}" for name in ("added_latency_ms", "added_latency_p99_ms", "oracle_latency_ms")),
            "" if ours or its is None else f"{its:.1f} {'>' if row['first'] else '<'}",
            "" if ours or equal is None else f"{equal:.1f} {'<' if row['beaten'] else '>'}",
            f"{100 * row['fair_late_share']:.2f}",
            f"{row['fair_latency_ms'] - row['fair_oracle_ms']:.1f}",
            "*" if row["on_front"] else "",
            style="bold" if ours else "",
        )
        preset = row["preset"]
    return result


def summary(rows: list[Row]) -> Table:
    """Returns a table of means over the seeds, and of how much less ours adds than each other at our late share."""
    result = Table(title="At our late share: added latency (ms), means over the seeds", box=box.SIMPLE_HEAD)
    for column in ("preset", "controller"):
        result.add_column(column, no_wrap=True)
    for column in ("late %", "added", "it needs", "ours is less by", "at least", "seeds"):
        result.add_column(column, justify="right", no_wrap=True)
    ours = {(row["preset"], row["seed"]): row["added_latency_ms"] for row in rows if row["controller"] == OURS}
    for preset, controller in dict.fromkeys((row["preset"], row["controller"]) for row in rows):
        group = [row for row in rows if (row["preset"], row["controller"]) == (preset, controller)]
        able = [row for row in group if row["its_latency_ms"] is not None]
        less = [row["its_latency_ms"] - ours[preset, row["seed"]] for row in able]
        named = (f"{100 * mean(group, 'late_inputs_share'):.2f}", f"{mean(group, 'added_latency_ms'):.1f}")
        if controller == OURS or len(able) < 2:
            result.add_row(preset, controller, *named, style="bold" if controller == OURS else "")
            continue
        scatter = f"{statistics.mean(less):.1f} ± {statistics.stdev(less) / math.sqrt(len(less)):.1f}"
        needs = f"{mean(able, 'its_latency_ms'):.1f}"
        result.add_row(preset, controller, *named, needs, scatter, f"{min(less):.1f}", str(len(able)))
    return result


def mean(rows: list[Row], name: str) -> float:
    return float(statistics.mean(row[name] for row in rows))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", choices=PRESETS, action="append", help="play only on this link; may be repeated")
    parser.add_argument("--minutes", type=float, default=10, help="simulated time per trial (default: %(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="first seed (default: %(default)d)")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds, from --seed on (default: %(default)d)")
    parser.add_argument("--json", type=File, metavar="OUT", help="write the rows to this file")
    chosen = parser.parse_args()
    names = chosen.preset or list(PRESETS)
    seeds = range(chosen.seed, chosen.seed + max(chosen.seeds, 1))
    with ProcessPoolExecutor() as pool:
        done = [pool.submit(run, name, chosen.minutes, seed) for name in names for seed in seeds]
        rows = [row for job in done for row in job.result()]
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)
    told = f"seed {chosen.seed}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"
    console.print(table(rows) if len(seeds) == 1 else summary(rows), f"{told}, {chosen.minutes:g} minutes each")
    if chosen.json:
        chosen.json.write_text(json.dumps({"seed": chosen.seed, "league": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
