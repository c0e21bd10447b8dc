"""The published rules of six systems for steering input timing, as lead controllers.

Each is fed with what that system knows, and nothing else: pings at its own interval, the snapshots' ticks as they
arrive, or the margins that the server reports. The rules are theirs, the code is ours; the files named are where
each project states its rule. Times in seconds, timelines in ticks (`client_sdk.clock`). Where a rule keeps a distance
for safety, that is a parameter here, so that the league can ask what the rule could do with a better one.
"""

import math
from collections import deque

from client_sdk.clock import ServerClock


class Rival:
    """What a controller may react to; by default to nothing.

    Args:
        rate: ticks per second.
        more: ticks on top of the rule's own safety.
        spread: the rule's multiple of the jitter, times this.
    """

    ping_s = 1.0
    """Pings are so far apart, once there have been five of them."""
    spreads: tuple[float, ...] = (1.0,)
    """What to try for `spread`; none: the rule keeps no distance, so there is nothing to set."""

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        self.rate = rate
        self.more = more
        self.spread = spread

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """A ping came back: the round trip, and the server's phase if both ways took the same time."""

    def heard(self, tick: int, now: float) -> None:
        """The snapshot of `tick` has arrived; the margins that it carried have been observed."""

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """As for `LeadController`."""

    def start(self, clock: ServerClock, now: float) -> float:
        """As for `LeadController`."""
        return clock.phase + clock.rtt_s / 2 * self.rate

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """As for `LeadController`."""
        return phase

    def step(self, clock: ServerClock) -> float:
        """As for `LeadController`; in the league no clock steps."""
        return clock.phase + clock.rtt_s / 2 * self.rate


class UnityN4E(Rival):
    """Netcode for Entities, `NetworkTimeSystem.cs` and `CommandReceiveSystem.cs`: closed loop on a mean.

    Each tick the server averages (1/8) by how much the newest command is older than the tick; every snapshot carries
    that age. The client adds a slack of two ticks, subtracts its own corrections of the last round trip, and runs
    10 % faster or slower per tick of the rest, at most by 10 %; ten ticks off, it starts from the estimate again.
    """

    SLACK = 2.0

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._age = 0.0
        self._newest = -1
        self._tick = -1
        self._told: float | None = None
        self._arrivals: deque[tuple[float, int]] = deque()
        self._corrections: deque[tuple[float, float]] = deque()

    def start(self, clock: ServerClock, now: float) -> float:
        """The estimate of the newest snapshot plus round trip and slack is half a round trip ahead of the server."""
        return super().start(clock, now) + self.SLACK + self.more

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """When the command arrived on the server, in ticks: what the server averages by itself."""
        self._arrivals.append((tick - margin, tick))

    def heard(self, tick: int, now: float) -> None:
        """Carries on the server's average up to the snapshot's tick."""
        if self._tick < 0:
            self._tick = tick - 1
        while self._tick < tick:
            self._tick += 1
            while self._arrivals and self._arrivals[0][0] <= self._tick:
                self._newest = self._arrivals.popleft()[1]
            if self._newest >= 0:
                self._age += (self._tick - self._newest - self._age) / 8
                self._told = self._age

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Timescale from what is left of the age."""
        while self._corrections and self._corrections[0][0] < now - clock.rtt_s:
            self._corrections.popleft()
        if self._told is None:
            return phase
        off = self._told + self.SLACK + self.more - sum(change for _, change in self._corrections)
        if abs(off) >= 10:
            self._corrections.clear()
            target = self.start(clock, now)
            return target if abs(target - phase) > 10 else phase
        change = elapsed * max(-0.1, min(0.1 * off, 0.1))
        self._corrections.append((now, change))
        return phase + change


class Lightyear(Rival):
    """lightyear, `timeline/sync.rs`, `input.rs`, `remote.rs`, `ping/estimator.rs`: open loop on pings.

    Ten pings a second; smoothed round trip (1/12) and deviation (1/6), outliers clamped; jitter is half the
    deviation. Aims at the remote timeline + RTT/2 + 4 jitter + three ticks. More than a tick off for three frames of
    the same sign, it runs up to 10 % faster or slower; ten ticks off, it snaps.
    """

    ping_s = 0.1
    spreads = (0.5, 1.0)

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._rtt: float | None = None
        self._deviation = 0.0
        self._remote: float | None = None
        self._same = 0
        self._sign = 1.0
        self._speed = 0.0

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """Smoothing with clamped outliers."""
        if self._rtt is None:
            self._rtt, self._deviation = rtt_s, rtt_s / 2
            return
        rtt_s = min(rtt_s, max(self._rtt + 3 * self._deviation, 3 * self._rtt), self._rtt + 0.5)
        self._deviation += (abs(rtt_s - self._rtt) - self._deviation) / 6
        self._rtt += (rtt_s - self._rtt) / 12

    def heard(self, tick: int, now: float) -> None:
        """The remote timeline: this tick, half a round trip ago; the more jitter, the smoother."""
        if self._rtt is None:
            return
        phase = tick + self._rtt / 2 * self.rate - self.rate * now
        steadiness = min(max((self._deviation / 2 - 0.001) / 0.009, 0.0), 1.0)
        weight = 0.10 - 0.08 * steadiness
        self._remote = phase if self._remote is None else self._remote + weight * (phase - self._remote)

    def _target(self, clock: ServerClock) -> float:
        rtt = clock.rtt_s if self._rtt is None else self._rtt
        remote = clock.phase if self._remote is None else self._remote
        return remote + (rtt / 2 + self.spread * 4 * self._deviation / 2) * self.rate + 3.0 + self.more

    def start(self, clock: ServerClock, now: float) -> float:
        """At the objective."""
        return self._target(clock)

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Speed in proportion to the error, fading by 10 % a frame."""
        off = self._target(clock) - phase
        if abs(off) > 10:
            self._same = 0
            return phase + off
        self._speed *= 0.9
        sign = math.copysign(1.0, off)
        self._same = self._same + 1 if abs(off) > 1 and sign == self._sign else int(abs(off) > 1)
        self._sign = sign
        if self._same >= 3:
            self._speed = sign * 0.05 * 2 * min(abs(off) / 10, 1.0)
        return phase + self._speed * elapsed


class Naia(Rival):
    """naia, `connection/time_manager.rs`: open loop on pings.

    One ping a second; averages (1/10) of offset and round trip from samples within one deviation. The sending
    timeline is latency + 3 jitter + four ticks + one of danger ahead of the server; within 50 ms it runs at normal
    speed; beyond, 20 ms more double or halve it, and so on up to tenfold.
    """

    spreads = (0.5, 1.0)

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._raw: tuple[float, float] | None = None
        self._mean = (0.0, 0.0)
        self._var = [0.0, 0.0]
        self._first: list[tuple[float, float]] = []

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """Both averages, pruned."""
        sample = (rtt_s, phase / self.rate)
        if self._raw is None:
            self._first.append(sample)
            if len(self._first) == 5:
                self._raw = self._mean = (sum(s[0] for s in self._first) / 5, sum(s[1] for s in self._first) / 5)
                self._var = [sum((s[i] - self._mean[i]) ** 2 for s in self._first) / 5 for i in (0, 1)]
            return
        self._raw = (0.9 * self._raw[0] + 0.1 * rtt_s, 0.9 * self._raw[1] + 0.1 * sample[1])
        off = [abs(sample[i] - self._raw[i]) for i in (0, 1)]
        self._var = [0.9 * self._var[i] + 0.1 * off[i] ** 2 for i in (0, 1)]
        if all(off[i] < math.sqrt(self._var[i]) for i in (0, 1)):
            self._mean = (0.9 * self._mean[0] + 0.1 * rtt_s, 0.9 * self._mean[1] + 0.1 * sample[1])

    def start(self, clock: ServerClock, now: float) -> float:
        """At the target."""
        jitter = math.sqrt(self._var[0]) / 2
        return (self._mean[1] + self._mean[0] / 2 + self.spread * 3 * jitter) * self.rate + 5.0 + self.more

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Speed by distance, never beyond the target."""
        off = self.start(clock, now) - phase
        beyond = (abs(off) / self.rate - 0.05) * 1000
        if beyond <= 0:
            return phase
        if off > 0:
            return phase + min(elapsed * min(beyond / 20, 9.0), off)
        return phase - min(elapsed * min(beyond / (beyond + 20), 0.9), -off)


class Netfox(Rival):
    """netfox, `network-time-synchronizer.gd`: the client lives at the server's time.

    Eight samples, 0.25 s apart, weighted by log(1 + RTT); an eighth of the mean offset at each; two seconds off, it
    resets. There is no lead: every input is late, and the server rolls back for it.
    """

    ping_s = 0.25
    spreads = ()

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._samples: deque[tuple[float, float]] = deque(maxlen=8)
        self._phase: float | None = None

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """Nudges its clock."""
        self._samples.append((math.log(1 + rtt_s), phase))
        mean = sum(w * p for w, p in self._samples) / sum(w for w, _ in self._samples)
        mine = mean if self._phase is None else self._phase
        self._phase = mean if abs(mean - mine) > 2 * self.rate else mine + (mean - mine) / 8

    def start(self, clock: ServerClock, now: float) -> float:
        """At the server's time."""
        return clock.phase if self._phase is None else self._phase

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Stretched by at most a quarter."""
        assert self._phase is not None
        return phase + max(-0.25 * elapsed, min(self._phase - phase, 0.25 * elapsed))


class DDNet(Rival):
    """DDNet, `smooth_time.cpp`, `client.cpp`, `server.cpp`: closed loop on each input's time left.

    Every input is answered with its time left; the target is where it would have had 10 ms. A lateness beyond 50 ms
    adds 5 to a counter (each good input takes 1) and is ignored below 15. The way up is gone at a speed (share of it
    per second) that doubles with each late input, up to 30, and falls by 5 % with each good one, down to 2; the way
    down at 0.3.
    """

    MARGIN_S = 0.010

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._up = 0.3
        self._spikes = 0
        self._target: float | None = None

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """A new target, and a new speed."""
        if margin < 0:
            spike = margin / self.rate < -0.05
            if spike:
                self._spikes = min(self._spikes + 5, 50)
            if spike and self._spikes < 15:
                return
            if self._up < 30:
                self._up *= 2
        else:
            self._spikes = max(self._spikes - 1, 0)
            self._up = max(self._up * 0.95, 2.0)
        self._target = phase - margin + self.MARGIN_S * self.rate + self.more

    def start(self, clock: ServerClock, now: float) -> float:
        """Half a round trip and the margin ahead."""
        return super().start(clock, now) + self.MARGIN_S * self.rate + self.more

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """A share of the way."""
        if self._target is None:
            return phase
        way = self._target - phase
        return phase + way * min(elapsed / self.rate * (self._up if way > 0 else 0.3), 1.0)


class Mirror(Rival):
    """Mirror, `NetworkTime.cs`, predicted time: open loop on the server's answer to pings.

    Ten pings a second; the server answers how far its time at the ping's arrival was ahead of the client's at
    sending, and the client adds the average of that (over 20) to its clock. So half of all inputs come too late by
    design: the mean is met.
    """

    ping_s = 0.1
    spreads = ()

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._ahead: float | None = None

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """An exponential average over 20."""
        ahead = phase + rtt_s / 2 * self.rate
        self._ahead = ahead if self._ahead is None else self._ahead + 2 / 21 * (ahead - self._ahead)

    def start(self, clock: ServerClock, now: float) -> float:
        """At the average."""
        return super().start(clock, now) if self._ahead is None else self._ahead

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Follows at once, as its clock does."""
        return phase if self._ahead is None else self._ahead


RIVALS: dict[str, type[Rival]] = {
    "Unity N4E": UnityN4E,
    "lightyear": Lightyear,
    "naia": Naia,
    "netfox": Netfox,
    "DDNet": DDNet,
    "Mirror": Mirror,
}
