"""A trial of one lead controller on one link, in simulated time.

It has no physics. It consists of a server that ticks, a client whose clock drifts and starts at a random time, pings,
one input per tick to the server, one snapshot per tick to the client with the arrival margins, and the controller. Its
*oracle* is the least constant lead that would have had the same share of late inputs, computed from the run's own
arrival times.
"""

import heapq
import math
import random
from collections import deque
from collections.abc import Callable, Iterable
from itertools import count
from typing import Any

from client_sdk.netsim.links import PRESETS, LinkEvents, TcpStream
from client_sdk.timing.lead import LeadController, PricedLead
from client_sdk.timing.server_clock import ServerClock
from client_sdk.timing.timeline import Timeline
from scripts.experiments.controllers import RIVALS
from scripts.experiments.rival import Rival

RATE = 32
TICK_MS = 1000 / RATE
INPUT_BYTES, PING_BYTES, SNAPSHOT_BYTES = 16, 12, 400
GATE_BYTES = 1448
DRIFT = 200e-6
AFTER_SPIKE_S = 0.25
AFTER_DIP_S = 1.0
OURS = "ours"
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
        self.link_events = LinkEvents(PRESETS[preset], rng.getrandbits(32))
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
        self._up = TcpStream(self, self.link_events, rng.getrandbits(32), self._at_server)
        self._down = TcpStream(self, self.link_events, rng.getrandbits(32), self._at_client)
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
        made, link_events = self.made[tick], self.link_events
        if 0 <= link_events.dipped(made) < AFTER_DIP_S:
            return False
        return not any(
            begin - 2 * link_events.path.rtt_s <= made < end + AFTER_SPIKE_S for begin, end, _ in link_events.spikes
        )

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
        half = self.link_events.path.rtt_s / 2 * RATE
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
