"""A ring buffer by tick: values of the newest `size` ticks, in one list that never grows."""

from typing import Generic, TypeVar

T = TypeVar("T")


class Ring(Generic[T]):
    """Values by tick. A value is forgotten when the value of a tick that is a multiple of `size` later replaces it."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._slots: list[tuple[int, T] | None] = [None] * size

    def put(self, tick: int, value: T) -> None:
        """Keeps the value of a tick."""
        self._slots[tick % self.size] = (tick, value)

    def get(self, tick: int) -> T | None:
        """Returns the value of a tick; None if none is kept."""
        slot = self._slots[tick % self.size]
        return slot[1] if slot is not None and slot[0] == tick else None
