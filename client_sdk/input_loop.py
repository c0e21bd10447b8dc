"""The input loop of one player: files, sends and predicts one input per tick, and learns how it fared at the server.

    update   compares the newest snapshot with the prediction; predicts every tick that is due; steers the timeline
    learn    takes input statuses and arrival margins from a snapshot; they decide the lead over the server
    view     returns what to draw

`newest` is the newest tick that has an input. After a lost connection, the input loop goes on in a new replica
(`world`) if the server's time is still the one that it knew. Otherwise nothing of it is valid, and a new `InputLoop`
begins.
"""

import math
import traceback
from collections.abc import Sequence

from client_sdk.controls import Controls
from client_sdk.events import BehaviourFailed, Diverged, Resynchronised
from client_sdk.pending_events import PendingEvents
from client_sdk.prediction.prediction import NONDETERMINISM, NOTHING
from client_sdk.replica import Replica
from client_sdk.sent_inputs import PRICE_S, ROWS_MAX, Arrival, SentInputs
from client_sdk.stats import Stats
from client_sdk.timing.lead import PricedLead, jump_ticks
from client_sdk.timing.timeline import Timeline
from client_sdk.view import View
from shared.bounds import AHEAD_S, bounds
from shared.inputs import row
from shared.messages import (
    IDLE,
    NEUTRALISED,
    REPEATED,
    USED,
    Inputs,
    Message,
    Restart,
    Resync,
    Snapshot,
)

LEAD_S_MAX = AHEAD_S
"""Longest possible lead in seconds. A timeline that is certainly further ahead starts again, because the server refuses
its inputs."""
PAUSED, SILENT, BEHIND, AHEAD = "program paused", "server silent", "server behind", "server ahead"
PATH, RECONNECTED = "path changed", "reconnected"
"""Causes of `Resynchronised`, explained there."""


class InputLoop:
    """The input loop of one player. Call `restart` after creating it.

    Args:
        world: a complete replica.
        stats: counters to update.
        events: receives the events.
        now: local time in seconds.
    """

    def __init__(self, world: Replica, stats: Stats, events: PendingEvents, now: float) -> None:
        self.world = world
        self._lead = PricedLead(PRICE_S)
        self.timeline = Timeline(world.clock.rate, self._lead.start(world.clock, now), now)
        self.newest = -1
        self.seen = 0.0
        """View tick of the latest view, in ticks; of the latest update if the program draws no views."""
        self._void = -1  # newest tick whose inputs were forgotten, because a restored server has none of them
        self._draws = False
        self._late = False
        self._silent = False
        self._settling: float | None = None
        self._settled = False
        self._step = self._stepped = 0.0
        self._bounds = bounds(world.scene.tick_rate)
        self._observed = [(-1, 0.0), (-1, 0.0)]
        """Newest tick with an observed margin, and its need, over the connection and over a second one."""
        self._sent = SentInputs(world.scene.tick_rate, world.scene.input_row_bytes)
        self._stats, self._events = stats, events

    def restart(self, now: float, cause: str) -> list[Message]:
        """Starts the prediction again at the timeline's tick.

        Args:
            now: local time in seconds.
            cause: the cause for `Resynchronised`.

        Returns:
            The messages to send. A `Restart` withdraws inputs that were sent for later ticks.
        """
        prediction = self.world.prediction
        confirmed = prediction.confirmed.tick
        # Bounded, even if the server reports a wrong time: all ticks after the confirmed one are replayed here.
        end = confirmed + self._bounds.unconfirmed
        tick = min(max(math.floor(self.timeline.tick(now)), confirmed), end)
        self._sent.restart()
        self._observed = [(-1, 0.0), (-1, 0.0)]
        messages: list[Message] = []
        ahead, jump = self.newest - tick, jump_ticks(self.timeline.rate)
        if cause == RECONNECTED and abs(ahead) > jump and self.world.newest_received < 0:
            prediction.forget_inputs()  # the server was restored, and they belong to another time
            self._void = tick
        if 0 < ahead <= jump and cause == RECONNECTED:
            tick = min(self.newest, end)
        elif ahead > 0:
            messages.append(Restart(tick + 1))
            self._sent.forget()
            self._settling = now
        if prediction.begun:
            self._stats.resyncs += 1
            self._events.append(Resynchronised(tick, tick - self.newest, cause))
        self.newest = tick
        prediction.begin(max(tick - prediction.ahead, confirmed))
        return messages

    def stepped(self, ticks: float, now: float) -> None:
        """Notes that the server's time has stepped by `ticks`; the next update follows the step.

        Until a ping sent after the step is answered, arrival margins belong to inputs from before it and are ignored.
        """
        self._step += ticks
        self._settling = now
        self.world.view_builder.interpolation.shift(ticks)

    def follow(self, now: float, *, online: bool) -> list[Message]:
        """Follows the steps of the server's time since the last call. Returns the messages to send before any ping."""
        ticks, self._step = self._step, 0.0
        if not ticks:
            return []
        timeline = self.timeline
        before, timeline.phase = timeline.phase, self._lead.step(self.world.clock) + timeline.own
        self._settling = now
        self._stepped += timeline.phase - before  # a server that stands still causes many small steps: they add up
        if abs(self._stepped) > jump_ticks(timeline.rate):
            if online:
                self._stepped = 0.0
                return self.restart(now, BEHIND if ticks < 0 else AHEAD)
            self._sent.forget()  # `restart` follows after the reconnect; margins until then are those of another time
        return []

    def prepare(self, snapshot: Snapshot, now: float) -> None:
        """Learns arrival margins from a second connection, so that inputs are in time over it, too."""
        # A margin of an input from before the second connection looks like one of an input that was refused.
        self._observe([each for each in self._sent.arrived(snapshot, 1) if not each.refused], now, 1)

    def begin_copies(self) -> None:
        """Notes that messages go over a second connection, too, from now on: it has not got the latest input."""
        self._sent.restart()

    def change_over(self) -> None:
        """Notes that a second connection has taken over: input statuses of the first may have been lost."""
        self._late = True
        self._sent.change_over()

    def answered(self, sent: float) -> None:
        """Notes that a ping sent at `sent` was answered, so the server has received everything sent before it."""
        if self._settling is not None and sent > self._settling:
            self._settling, self._settled = None, True

    def update(self, now: float, controls: Controls, *, online: bool) -> list[Message]:
        """Reconciles, then predicts every tick that is due.

        Args:
            now: local time in seconds.
            controls: source of the inputs.
            online: whether there is a connection; without one, nothing is reconciled and nothing is sent.

        Returns:
            The messages to send.
        """
        world, stats = self.world, self._stats
        clock = world.clock
        server_tick = clock.tick(now)
        stats.measure(now)
        alarm = False
        if online:
            alarm = self._reconcile(now)
            interpolation = world.view_builder.interpolation
            interpolation.advance(server_tick, now)
            if not self._draws:
                self.seen = interpolation.shown(server_tick)
        messages = self._predict(now, controls)
        self._tell()
        stats.snapshot_age_s = max(server_tick - world.prediction.confirmed.tick, 0.0) / clock.rate
        if not online:
            return []
        # Steering comes last, so that it cannot postpone a tick that is due and for which the program woke up.
        if self.timeline.steer(self._lead, clock, now) or self._out_of_bounds(now):
            messages += self.restart(now, PATH)
        if alarm:
            messages.insert(0, Resync())
        return messages

    def _tell(self) -> None:
        """Files the events of predicted behaviours."""
        prediction = self.world.prediction
        if prediction.announcements.events:
            for event in prediction.announcements.take():
                self._events.append(event)
        for tick, entity, behaviour, error in prediction.failures:
            text = "".join(traceback.format_exception(error)[-2:]).strip()
            self._events.append(BehaviourFailed(tick, entity, behaviour, text))
        prediction.failures.clear()

    def next_tick(self, now: float) -> float:
        """Returns the local time at which the next tick is due; `inf`: not before a snapshot arrives."""
        limits = self._bounds
        end, to = self.world.prediction.confirmed.tick + limits.unconfirmed, math.floor(self.timeline.tick(now))
        waits = self.newest >= end or (to - self.newest > limits.update and to > end)
        return math.inf if waits else self.timeline.when(self.newest + 1)

    def view(self, now: float) -> View:
        """Returns what to draw now."""
        view = self.world.view_builder.view(self.timeline, self.world.clock, now)
        self._draws, self.seen = True, view.seen
        return view

    def learn(self, snapshot: Snapshot, now: float) -> None:
        """Learns from a snapshot how the inputs fared at the server.

        Arrival margins go to the lead controller. Input statuses are counted, and a missing input sets `_late`, which
        becomes the cause of a correction.
        """
        stats, sent, statuses = self._stats, self._sent, snapshot.statuses
        arrivals = sent.arrived(snapshot)
        for arrival in arrivals:
            stats.inputs_refused += arrival.refused
            stats.inputs_late += arrival.late
        self._observe(arrivals, now)
        if self._settling is not None or self._settled:  # the server may have used inputs that were withdrawn
            self._late, self._settled = True, False
        used, missing = statuses.count(USED), sent.replaced(snapshot)
        stats.inputs_used += used - missing
        if used < len(statuses):
            for tick, status in enumerate(statuses, snapshot.first):
                if status in (REPEATED, NEUTRALISED):
                    missing += 1
                    stats.inputs_late += sent.has(tick) and not sent.changed(tick)
                elif status == IDLE:  # the very first inputs were late, and the server had no earlier one to repeat
                    missing += sent.has(tick)
            stats.inputs_neutralised += statuses.count(NEUTRALISED)
        stats.inputs_substituted += missing
        self._late |= missing > 0

    def _observe(self, arrivals: Sequence[Arrival], now: float, connection: int = 0) -> None:
        """Passes the needs of messages (`client_sdk.timing.lead`) to the lead, and needs for the ticks between them.

        Args:
            arrivals: the messages that a snapshot reports.
            now: local time in seconds.
            connection: 1 for a second connection, else 0.
        """
        if not arrivals or self._settling is not None:
            return
        needs = [(arrival.tick, arrival.need) for arrival in arrivals]
        clock, (before, last) = self.world.clock, self._observed[connection]
        for tick, need in self._sent.filled(needs, before, last, clock.rtt_s * clock.rate):
            self._lead.observe(tick, 0.0, need, now)
        self._observed[connection] = needs[-1]

    def unreceived(self) -> list[Message]:
        """Returns the inputs to send again after a reconnect: those that the server may not have received yet."""
        prediction, newest = self.world.prediction, self.newest
        since = max(self.world.newest_received, prediction.confirmed.tick, newest - self._bounds.ahead, self._void)
        self._sent.again(since, newest)
        return [
            Inputs(
                first + 1,
                prediction.confirmed.tick,
                prediction.rows_since(first, min(first + ROWS_MAX, newest)),
            )
            for first in range(since, newest, ROWS_MAX)
        ]

    def _out_of_bounds(self, now: float) -> bool:
        """Sets the timeline to a new start if it is so far off that no input can count. Returns whether it was.

        It is too far off if its phase is behind the confirmed tick, or more than `LEAD_S_MAX` ahead of the server.
        """
        clock, timeline = self.world.clock, self.timeline
        reached = self.world.prediction.confirmed.tick - timeline.rate * now
        if reached <= timeline.phase <= clock.phase + (LEAD_S_MAX + clock.rtt_s / 2) * timeline.rate:
            return False
        self._lead = PricedLead(PRICE_S)
        timeline.phase = max(self._lead.start(clock, now), reached + clock.rtt_s / 2 * timeline.rate) + timeline.own
        return True

    def _reconcile(self, now: float) -> bool:
        """Compares the prediction with the newest snapshot, once per update even if several have arrived.

        Returns:
            Whether the confirmed world is wrong and has to be fetched again.
        """
        world, stats = self.world, self._stats
        done = world.prediction.reconcile(self._late)
        self._late = False
        if done is not NOTHING:
            stats.replayed_ticks += done.replayed
            stats.repredictions += done.repredicted
            world.view_builder.smooth(done, now)
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

    def _predict(self, now: float, controls: Controls) -> list[Message]:
        """Files an input for every tick up to now, and predicts up to that tick minus the input delay.

        Returns:
            The messages to send.
        """
        prediction, timeline, stats = self.world.prediction, self.timeline, self._stats
        confirmed, to = prediction.confirmed.tick, math.floor(timeline.tick(now))
        end = confirmed + self._bounds.unconfirmed
        if to - self.newest > self._bounds.update:
            controls.forget()
            if to <= end:
                self.restart(now, SILENT if self._silent else PAUSED)
            return []
        inputs: list[Message] = []
        self._silent = to > end
        to = min(to, end)
        first = self.newest + 1  # late inputs are sent, too: their margins show how much more lead is needed
        self.newest = max(to, first - 1)
        if to >= first:
            clock, phase = self.world.clock, timeline.phase
            timeline.made(timeline.tick(now) - first, now)
            phases: list[float] = []
            rows, scene = b"", self.world.scene
            for tick in range(first, to + 1):
                input_ = controls.take()
                prediction.file(tick, input_)
                rows += row(input_, aim=scene.aim)
                # Delays of a slow program are left out of the phase, because the path did not cause them.
                phases.append(phase - (timeline.tick(now) - tick) if timeline.own else phase)
            stats.inputs_sent += to + 1 - first
            stats.lead_ticks = phase - clock.phase
            stats.lead_s = stats.lead_ticks / clock.rate
            inputs = self._sent.send(first, rows, phases, confirmed)
        elif self._silent:
            controls.forget()
        while prediction.predicted.tick < self.newest - prediction.ahead:
            prediction.step()
        return inputs
