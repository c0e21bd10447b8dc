"""The log of a match on many processes in simulated time. It can fail in every way that a real one can.

Theory of operation. A part asks over the bus, and the answer comes over the bus. What was asked may have happened if
there is no answer. As `server.cluster.nats_bus` does, a part whose record is refused asks for the newest record, so a
refusal may be older than what it says.
"""

import random
from bisect import bisect_right
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from server.cluster.bus import BusError, RefusedError
from server.scale.replica import Replica
from server.scale.wire import record_of
from server.scale.writer import EMPTY, Entry

if TYPE_CHECKING:
    from sovereign_netcode.playtest.scaled import ScaledMatch

Failure = Literal["full", "deaf", "mute", "leaky"]
"""A way to fail. "full": it stores nothing, and says so. "deaf": it gets nothing. "mute": it stores, and its answers
are lost. "leaky": each request and each answer is lost, or not stored, by chance."""
FAILURES: tuple[Failure, ...] = ("full", "deaf", "mute", "leaky")
LEAK = 0.3
"""Share of the requests, and of the answers, that a leaky log loses."""
ACK_S = 0.5
"""Seconds after which there is no answer any more."""
REFUSED = "refused"

Answer = str | Exception
"""The id of the newest record, or of the one that was stored; or the error."""


class Log:
    """A simulated log.

    Args:
        match: has the simulated time and the bus.
        seed: source of everything random.
        fails: about every `fails[0]` seconds, the log fails in a way by chance for up to `fails[1]` seconds.
    """

    def __init__(self, match: "ScaledMatch", seed: int, fails: tuple[float, float] | None = None) -> None:
        self._match, self._rng = match, random.Random(seed)
        self.fails = fails
        """Time between two failures and their longest time, in seconds; None: it does not fail any more."""
        self.records: list[bytes] = []
        """All records that the log has accepted."""
        self.refused = 0
        """Number of records that were refused, because they did not follow the newest one."""
        self.failures = 0
        """Number of requests that had no answer, or an error."""
        self.failing: Failure | None = None
        self.newest = EMPTY
        """Id of the newest record."""
        self.on_stored: Callable[[Entry], None] = lambda entry: None
        """Function that is called with each record that was stored."""
        self._ids: set[str] = set()
        self._order: list[tuple[int, int]] = []
        if fails is not None:
            self._match.at(self._rng.uniform(0.5, 1.5) * fails[0], self._fail_by_chance)

    def fail(self, how: Failure, seconds: float) -> None:
        """Lets the log fail from now on for some time."""
        self.failing = how
        self._match.at(self._match.now + seconds, self.heal, key=self)

    def heal(self) -> None:
        """Ends a failure."""
        self.failing = None

    def place(self, replica: Replica) -> int:
        """Returns the number of records that a replica has."""
        return bisect_right(self._order, (replica.epoch, replica.world.tick))

    def append(self, source: str, entry: Entry, answered: Callable[[Answer], None]) -> None:
        """Appends a record. Calls a function with what became of it: its id, a `RefusedError` or a `BusError`."""

        def ended(answer: Answer) -> None:
            if isinstance(answer, str) and answer != entry.id:
                answer = RefusedError(answer)
            answered(answer)

        def stored(answer: Answer) -> None:
            if answer == REFUSED:
                self.end(source, ended)
            else:
                answered(answer)

        self._ask(source, lambda: self.store(entry), stored, stores=True)

    def end(self, source: str, answered: Callable[[Answer], None]) -> None:
        """Asks for the newest record. Calls a function with its id, or with a `BusError`."""
        self._ask(source, lambda: self.newest, answered, stores=False)

    def store(self, entry: Entry) -> str:
        """Stores a record if it follows the newest one. Returns its id, or `REFUSED`. Takes one again that it has."""
        if entry.id in self._ids:
            return entry.id
        if entry.after != self.newest:
            self.refused += 1
            return REFUSED
        record = record_of(entry.data)
        self._ids.add(entry.id)
        self._order.append((record.epoch, record.tick))
        self.records.append(entry.data)
        self.newest = entry.id
        self.on_stored(entry)
        return entry.id

    def _ask(self, source: str, act: Callable[[], str], answered: Callable[[Answer], None], *, stores: bool) -> None:
        match, waiting = self._match, [answered]

        def answer(with_: Answer) -> None:
            if waiting:
                waiting.pop()(with_)

        def come() -> None:
            how = self.failing
            lost = how == "leaky" and self._rng.random() < LEAK
            if how == "deaf" or lost:
                return
            error = stores and (how == "full" or (how == "leaky" and self._rng.random() < LEAK))
            self.failures += error
            said: Answer = BusError("not stored") if error else act()
            if how != "mute" and not (how == "leaky" and self._rng.random() < LEAK):
                match.bus.send("log", source, lambda: answer(said))

        def give_up() -> None:
            if waiting:
                self.failures += 1
                answer(BusError("no answer"))

        match.bus.send(source, "log", come)
        match.at(match.now + ACK_S, give_up)

    def _fail_by_chance(self) -> None:
        if self.fails is not None:
            self.fail(self._rng.choice(FAILURES), self._rng.uniform(0.0, self.fails[1]))
            self._match.at(self._match.now + self._rng.uniform(0.5, 1.5) * self.fails[0], self._fail_by_chance)
