"""The published rules of six systems for the timing of inputs, as lead controllers.

Each controller gets only the data that its system has: pings at its own interval, the ticks of arriving snapshots, or
the margins that the server reports. The rules are those of the systems, the code is ours. Each docstring names the
files in which a project states its rule. Times are in seconds, timelines in ticks (`client_sdk.timing.lead`). A rule's
safety distance is a parameter here, so that the league can measure the rule with a better one.
"""

import math
from collections import deque

from client_sdk.timing.server_clock import ServerClock
from scripts.experiments.rival import Rival


class UnityN4E(Rival):
    """Netcode for Entities, `NetworkTimeSystem.cs` and `CommandReceiveSystem.cs`: closed loop on a mean.

    In each tick the server averages (weight 1/8) how much older than the tick the newest command is. Every snapshot
    carries that age. The client adds a slack of two ticks and subtracts its own corrections of the last round trip. It
    runs 10 % faster or slower per tick of the rest, at most by 10 %. If the rest is ten ticks, it starts from the
    estimate again.
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
        """Returns the estimate: the newest snapshot + RTT + slack, which is half an RTT + slack ahead of the server."""
        return super().start(clock, now) + self.SLACK + self.more

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """Remembers when a command arrived at the server, in ticks, for the server's average."""
        self._arrivals.append((tick - margin, tick))

    def heard(self, tick: int, now: float) -> None:
        """Advances the server's average up to the snapshot's tick."""
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
        """Changes the speed in proportion to the rest of the age."""
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

    It sends ten pings a second, and smooths the round trip (weight 1/12) and its deviation (1/6), with outliers
    clamped. The jitter is half the deviation. The objective is the remote timeline + RTT/2 + 4 jitter + three ticks.
    After three frames that are more than a tick off in the same direction, it runs up to 10 % faster or slower. If it
    is ten ticks off, it snaps.
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
        """Smooths the round trip and its deviation, with outliers clamped."""
        if self._rtt is None:
            self._rtt, self._deviation = rtt_s, rtt_s / 2
            return
        rtt_s = min(rtt_s, max(self._rtt + 3 * self._deviation, 3 * self._rtt), self._rtt + 0.5)
        self._deviation += (abs(rtt_s - self._rtt) - self._deviation) / 6
        self._rtt += (rtt_s - self._rtt) / 12

    def heard(self, tick: int, now: float) -> None:
        """Smooths the remote timeline, where `tick` was half a round trip ago. More jitter smooths more."""
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
        """Returns the objective."""
        return self._target(clock)

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Sets a speed in proportion to the error, which fades by 10 % per frame."""
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

    It sends one ping a second, and averages (weight 1/10) offset and round trip over the samples within one deviation.
    The sending timeline is ahead of the server by latency + 3 jitter + four ticks + one tick against danger. Within
    50 ms of that it runs at normal speed. A distance of 20 ms more doubles or halves the speed, 40 ms more triple it or
    divide it by three, and so on up to tenfold.
    """

    spreads = (0.5, 1.0)

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._raw: tuple[float, float] | None = None
        self._mean = (0.0, 0.0)
        self._var = [0.0, 0.0]
        self._first: list[tuple[float, float]] = []

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """Updates both averages, without the samples beyond one deviation."""
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
        """Returns the target."""
        jitter = math.sqrt(self._var[0]) / 2
        return (self._mean[1] + self._mean[0] / 2 + self.spread * 3 * jitter) * self.rate + 5.0 + self.more

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Sets a speed by the distance from the target, without passing it."""
        off = self.start(clock, now) - phase
        beyond = (abs(off) / self.rate - 0.05) * 1000
        if beyond <= 0:
            return phase
        if off > 0:
            return phase + min(elapsed * min(beyond / 20, 9.0), off)
        return phase - min(elapsed * min(beyond / (beyond + 20), 0.9), -off)


class Netfox(Rival):
    """netfox, `network-time-synchronizer.gd`: the client's time is the server's time.

    It takes eight samples, 0.25 s apart, weighted by log(1 + RTT), and corrects an eighth of the mean offset at each.
    If it is two seconds off, it resets. There is no lead: every input is late, and the server rolls back for it.
    """

    ping_s = 0.25
    spreads = ()

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._samples: deque[tuple[float, float]] = deque(maxlen=8)
        self._phase: float | None = None

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """Corrects an eighth of the offset."""
        self._samples.append((math.log(1 + rtt_s), phase))
        mean = sum(w * p for w, p in self._samples) / sum(w for w, _ in self._samples)
        mine = mean if self._phase is None else self._phase
        self._phase = mean if abs(mean - mine) > 2 * self.rate else mine + (mean - mine) / 8

    def start(self, clock: ServerClock, now: float) -> float:
        """Returns the server's time."""
        return clock.phase if self._phase is None else self._phase

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Approaches the corrected time, at most a quarter faster or slower."""
        assert self._phase is not None
        return phase + max(-0.25 * elapsed, min(self._phase - phase, 0.25 * elapsed))


class DDNet(Rival):
    """DDNet, `smooth_time.cpp`, `client.cpp`, `server.cpp`: closed loop on each input's time left.

    The server answers every input with its time left. The target is the time at which the input would have had 10 ms
    left. An input more than 50 ms late adds 5 to a counter, from which each good input takes 1. Such an input is
    ignored while the counter is below 15. Upwards, the timeline goes a share of the distance per second that doubles
    with each late input, up to 30, and falls by 5 % with each good one, down to 2. Downwards, the share is 0.3.
    """

    MARGIN_S = 0.010

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._up = 0.3
        self._spikes = 0
        self._target: float | None = None

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """Updates the target and the speed."""
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
        """Returns half a round trip and the margin ahead of the server."""
        return super().start(clock, now) + self.MARGIN_S * self.rate + self.more

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Goes a share of the distance to the target."""
        if self._target is None:
            return phase
        way = self._target - phase
        return phase + way * min(elapsed / self.rate * (self._up if way > 0 else 0.3), 1.0)


class Mirror(Rival):
    """Mirror, `NetworkTime.cs`, predicted time: open loop on the server's answer to pings.

    It sends ten pings a second. The server answers by how much its time at a ping's arrival was ahead of the client's
    time at sending. The client adds the average of the last 20 answers to its clock. Half of all inputs arrive too
    late by design, because the timeline is at the mean.
    """

    ping_s = 0.1
    spreads = ()

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        super().__init__(rate, more, spread)
        self._ahead: float | None = None

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """Updates an exponential average over 20 pings."""
        ahead = phase + rtt_s / 2 * self.rate
        self._ahead = ahead if self._ahead is None else self._ahead + 2 / 21 * (ahead - self._ahead)

    def start(self, clock: ServerClock, now: float) -> float:
        """Returns the average."""
        return super().start(clock, now) if self._ahead is None else self._ahead

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Jumps to the average, as the system's clock does."""
        return phase if self._ahead is None else self._ahead


RIVALS: dict[str, type[Rival]] = {
    "Unity N4E": UnityN4E,
    "lightyear": Lightyear,
    "naia": Naia,
    "netfox": Netfox,
    "DDNet": DDNet,
    "Mirror": Mirror,
}
