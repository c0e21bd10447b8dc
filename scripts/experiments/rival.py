"""The base of the lead controllers that the league compares with ours."""

from client_sdk.timing.server_clock import ServerClock


class Rival:
    """The base of the controllers, with the events that one can react to. It reacts to none.

    Args:
        rate: ticks per second.
        more: ticks to add to the rule's own safety distance.
        spread: factor on the rule's multiple of the jitter.
    """

    ping_s = 1.0
    """Seconds between two pings, after the first five."""
    spreads: tuple[float, ...] = (1.0,)
    """Values of `spread` that the league tries; empty if the rule keeps no safety distance."""

    def __init__(self, rate: float, more: float = 0.0, spread: float = 1.0) -> None:
        self.rate = rate
        self.more = more
        self.spread = spread

    def answered(self, rtt_s: float, phase: float, now: float) -> None:
        """Takes the result of a ping: the round trip, and the server's phase if both directions took the same time."""

    def heard(self, tick: int, now: float) -> None:
        """Takes the arrival of the snapshot of `tick`, after `observe` has taken its margins."""

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """Takes an input's arrival margin (`LeadController.observe`)."""

    def start(self, clock: ServerClock, now: float) -> float:
        """Returns the first phase: half a round trip ahead of the server (`LeadController.start`)."""
        return clock.phase + clock.rtt_s / 2 * self.rate

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Returns the new phase, here the old one (`LeadController.steer`)."""
        return phase

    def step(self, clock: ServerClock) -> float:
        """Returns the phase after a step of the clock (`LeadController.step`). In the league no clock steps."""
        return clock.phase + clock.rtt_s / 2 * self.rate
