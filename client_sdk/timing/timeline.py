"""The client's own time, which runs ahead of the server and says when each input is made."""

from client_sdk.timing.lead import FASTER, LeadController, jump_ticks
from client_sdk.timing.server_clock import ServerClock
from shared.bounds import UPDATE_S

SLOW_S = 0.1
"""A program that makes an input this late, in seconds, three times in a row counts as slow; once or twice may be a
short delay."""


class Timeline:
    """The client's own time in ticks: continuous, and ahead of the server.

    It is ahead by the lead that a `LeadController` sets for the path, plus `own` ticks for a slow program: such a
    program sends the inputs of one update together, the first of them long after its time.
    """

    def __init__(self, rate: float, phase: float, now: float) -> None:
        self.rate = rate
        self.phase = phase
        self.own = 0.0
        self._steered = now
        self._late = (0.0, 0.0, 0.0)

    def tick(self, now: float) -> float:
        """Returns the timeline's tick at the local time `now`, with a fraction."""
        return self.rate * now + self.phase

    def when(self, tick: float) -> float:
        """Returns the local time at which `tick` is reached if the phase stays as it is, in seconds."""
        return (tick - self.phase) / self.rate

    def made(self, late: float, now: float) -> None:
        """Notes that the first input of an update was made `late` ticks after its time.

        If that is more than `SLOW_S`, the next input may be as late as the time between two updates.
        """
        slow = late > SLOW_S * self.rate
        self._late = (*self._late[1:], max(late, (now - self._steered) * self.rate) if slow else 0.0)

    def steer(self, lead: LeadController, clock: ServerClock, now: float) -> bool:
        """Moves the phase to where the controller wants it. Returns whether that was a jump."""
        before = self.phase
        elapsed = max(now - self._steered, 0.0) * self.rate
        self._steered = now
        path = lead.steer(before - self.own, elapsed, clock, now)
        if self.own or min(self._late) > SLOW_S * self.rate:
            self._follow_program(elapsed)
        self.phase = path + self.own
        return abs(self.phase - before) > jump_ticks(self.rate)

    def _follow_program(self, elapsed: float) -> None:
        """Adapts `own` to how late the program makes inputs: it rises at once and falls slowly."""
        least = min(self._late)
        slow = min(max(self._late), 2 * least, UPDATE_S * self.rate) if least > SLOW_S * self.rate else 0.0
        self.own = max(slow, self.own - FASTER * elapsed)
