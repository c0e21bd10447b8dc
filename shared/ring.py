"""A ring buffer by tick: the newest `size` ticks of anything, in one list that never grows."""

from typing import Generic, TypeVar

T = TypeVar("T")


class Ring(Generic[T]):
    """Values by tick; a value is forgotten once one `size` ticks newer takes its place."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._slots: list[tuple[int, T] | None] = [None] * size

    def put(self, tick: int, value: T) -> None:
        """Keeps a value."""
        self._slots[tick % self.size] = (tick, value)

    def get(self, tick: int) -> T | None:
        """The value of a tick, or None if there is none (any more)."""
        slot = self._slots[tick % self.size]
        return slot[1] if slot is not None and slot[0] == tick else None
