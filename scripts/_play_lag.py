"""A client on a slower line than it has: everything that comes or goes is held back for a while, in order."""

from collections import deque

from client_sdk.core import Core


class LaggedCore(Core):
    """`lag_s` is added to the round trip, half to each way; it may change at any time."""

    lag_s = 0.0

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._coming: deque[tuple[float, bytes]] = deque()
        self._going: deque[tuple[float, bytes]] = deque()
        self._now = 0.0

    def receive(self, data: bytes, now: float) -> None:
        self._coming.append((now + self.lag_s / 2, data))
        self._deliver(now)

    def lost(self, code: int, reason: str, now: float) -> None:
        self._coming.clear()  # the line is cut, and what was on it is gone
        self._going.clear()
        super().lost(code, reason, now)

    def update(self, now: float) -> None:
        self._deliver(now)
        super().update(now)

    def outgoing(self) -> list[bytes]:
        self._going += [(self._now + self.lag_s / 2, message) for message in super().outgoing()]
        ready = []
        while self._going and (self._going[0][0] <= self._now or self.state == "closed"):
            ready.append(self._going.popleft()[1])
        return ready

    def _deliver(self, now: float) -> None:
        self._now = now
        while self._coming and self._coming[0][0] <= now:
            super().receive(self._coming.popleft()[1], now)
