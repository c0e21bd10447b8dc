"""One player's ticks, from the first to the last: each has a wish, which is sent and predicted, and later a fate.

    update   compares the newest snapshot with what was predicted; predicts every tick whose time has come; steers
    learn    how the inputs fared at the server: what decides how far ahead of it to live
    view     what to draw

`newest` is the newest tick that has an input. After a lost connection the play goes on in another copy of the world
(`world`), unless the server's time is another one, too: then there is nothing to go on with, and another play begins.
"""

import math
from collections import deque
from struct import iter_unpack

from client_sdk.clock import PricedLead, Timeline
from client_sdk.events import Diverged, Event, Resynchronised
from client_sdk.picture import View
from client_sdk.prediction import NONDETERMINISM, NOTHING
from client_sdk.replica import Replica
from client_sdk.stats import Stats
from shared.inputs import Input, row
from shared.messages import (
    IDLE,
    INPUT_ROWS_MAX,
    MARGIN_ONE,
    MARGIN_REFUSED,
    NEUTRALISED,
    REPEATED,
    USED,
    Inputs,
    Message,
    Resync,
    Snapshot,
)
from shared.ring import Ring

TICKS_PER_UPDATE_MAX = 16
"""A program that was away for longer does not catch up tick by tick: it begins anew. No message has more inputs."""
UNCONFIRMED_MAX = 96
"""So many ticks beyond the newest snapshot, prediction waits."""


class Play:
    """Begins once `world` is complete; `restart` has to follow.

    Args:
        stats, events: are told what happens.
    """

    def __init__(self, world: Replica, stats: Stats, events: deque[Event], now: float) -> None:
        self.world = world
        self._lead = PricedLead()
        self.timeline = Timeline(world.clock.rate, self._lead.start(world.clock, now), now)
        self.newest = -1
        self.seen = 0.0
        """The tick of the last view of others; of the last update, where nothing is drawn."""
        self._draws = False
        self._late = False
        self._phases: Ring[float] = Ring(256)
        self._stats, self._events = stats, events

    def restart(self, now: float) -> None:
        """Begins the prediction at the timeline's tick."""
        prediction = self.world.prediction
        confirmed = prediction.confirmed.tick
        # Bounded, whatever the server says of its time: all ticks since the confirmed one are replayed here.
        tick = min(max(math.floor(self.timeline.tick(now)), confirmed, self.newest), confirmed + UNCONFIRMED_MAX)
        if prediction.begun:
            self._stats.resyncs += 1
            self._events.append(Resynchronised(tick, tick - self.newest))
        self.newest = tick
        prediction.begin(max(tick - prediction.ahead, confirmed))

    def update(self, now: float, wish: Input, *, online: bool) -> list[Message]:
        """Predicts every tick whose time has come, with `wish`; what to send.

        Without a connection (not `online`), nothing new can be known, and nothing is sent.
        """
        world, stats = self.world, self._stats
        clock = world.clock
        server_tick = clock.tick(now)
        stats.measure(now)
        alarm = False
        if online:
            alarm = self._reconcile(now)
            shown = world.picture.advance(server_tick, now)
            if not self._draws:
                self.seen = shown
        messages = self._predict(now, wish)
        stats.snapshot_age_s = max(server_tick - world.prediction.confirmed.tick, 0.0) / clock.rate
        if not online:
            return []
        # Steered only now: a tick that was due, and for which the program woke up, is not put off by a moment.
        if self.timeline.steer(self._lead, clock, now):
            self.restart(now)
        if alarm:
            messages.insert(0, Resync())
        return messages

    def next_tick(self, now: float) -> float:
        """The local time at which there is one to predict; inf: not before something has come in."""
        end, to = self.world.prediction.confirmed.tick + UNCONFIRMED_MAX, math.floor(self.timeline.tick(now))
        waits = self.newest >= end or (to - self.newest > TICKS_PER_UPDATE_MAX and to > end)
        return math.inf if waits else self.timeline.when(self.newest + 1)

    def view(self, now: float) -> View:
        """What to draw now."""
        view = self.world.picture.view(self.timeline, self.world.clock, now)
        self._draws, self.seen = True, view.seen
        return view

    def learn(self, snapshot: Snapshot, now: float) -> None:
        """How the inputs fared: feeds the lead, and tells whether any of these ticks lacked its own."""
        stats, phases, margins, fates = self._stats, self._phases, snapshot.margins, snapshot.fates
        for tick, (margin,) in enumerate(iter_unpack("<h", margins), snapshot.newest + 1 - len(margins) // 2):
            phase = phases.get(tick)
            if phase is None:
                continue  # a tick that was left out
            if margin == MARGIN_REFUSED:
                stats.inputs_refused += 1
                continue
            stats.inputs_late += margin < 0
            self._lead.observe(tick, margin / MARGIN_ONE, phase, now)
        if fates.count(USED) == len(fates):
            return
        neutralised = fates.count(NEUTRALISED)
        missing = fates.count(REPEATED) + neutralised
        if IDLE in fates:  # the very first ones came late: until then nothing stood in for them
            ticks = enumerate(fates, snapshot.first)
            missing += sum(fate == IDLE and phases.get(tick) is not None for tick, fate in ticks)
        stats.inputs_substituted += missing
        stats.inputs_neutralised += neutralised
        self._late |= missing > 0

    def unheard(self) -> list[Message]:
        """The inputs that the server may still want, after a lost connection."""
        prediction, newest = self.world.prediction, self.newest
        since = max(self.world.heard, prediction.confirmed.tick, newest - INPUT_ROWS_MAX)
        return [
            Inputs(
                first + 1,
                prediction.confirmed.tick,
                prediction.rows_since(first, min(first + TICKS_PER_UPDATE_MAX, newest)),
            )
            for first in range(since, newest, TICKS_PER_UPDATE_MAX)
        ]

    def _reconcile(self, now: float) -> bool:
        """Compares the prediction with the newest snapshot, once per update, however many have come; whether the
        copy of the world has to be fetched anew."""
        world, stats = self.world, self._stats
        done = world.prediction.reconcile(self._late)
        self._late = False
        if done is not NOTHING:
            stats.replayed_ticks += done.replayed
            stats.repredictions += done.repredicted
            world.picture.smooth(done, now)
            if done.correction:
                stats.corrected(done.correction)
                self._events.append(done.correction)
                if done.correction.cause == NONDETERMINISM:
                    world.wrong = f"own {', '.join(done.correction.fields)}"
        if not world.wrong:
            return False
        stats.divergences += 1
        self._events.append(Diverged(world.prediction.confirmed.tick, world.wrong))
        world.wrong = ""
        return True

    def _predict(self, now: float, wish: Input) -> list[Message]:
        """Files the wish for every tick up to now, and predicts up to there but for the input delay; what to send."""
        prediction, timeline, stats = self.world.prediction, self.timeline, self._stats
        confirmed, to = prediction.confirmed.tick, math.floor(timeline.tick(now))
        if to - self.newest > TICKS_PER_UPDATE_MAX:
            if to - confirmed <= UNCONFIRMED_MAX:
                self.restart(now)
            return []
        inputs: list[Message] = []
        to = min(to, confirmed + UNCONFIRMED_MAX)
        first = max(self.newest, confirmed) + 1  # an input for the past would only be late
        self.newest = max(to, first - 1)
        if to >= first:
            clock, phase = self.world.clock, timeline.phase
            for tick in range(first, to + 1):
                prediction.file(tick, wish)
                self._phases.put(tick, phase)
            stats.inputs_sent += to + 1 - first
            stats.rtt_s = clock.rtt_s
            stats.lead_ticks = phase - clock.phase
            stats.lead_s = stats.lead_ticks / clock.rate
            inputs.append(Inputs(first, confirmed, row(wish) * (to + 1 - first)))
        while prediction.predicted.tick < self.newest - prediction.ahead:
            prediction.step()
        return inputs
