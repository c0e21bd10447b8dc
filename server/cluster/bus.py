"""The interface to a bus: the batches of the edges, the log of a world, its checkpoint, and shared keys with values.

`server.cluster.local_bus` joins parts in one process; `server.cluster.nats_bus` joins processes.
"""

from collections.abc import AsyncIterator, Callable
from typing import NamedTuple, Protocol

from server.scale.writer import Entry


class BusError(Exception):
    """The bus does not answer, or not in time. What was asked may have happened or not."""


class RefusedError(Exception):
    """The log has refused a record. `last` is the id of its newest record; empty: it has none."""

    def __init__(self, last: str) -> None:
        super().__init__(f"refused: the newest record of the log is {last or 'none'}")
        self.last = last


class PurgedError(Exception):
    """The log does not have the wanted records any more: a newer checkpoint has them."""


class ConflictError(Exception):
    """A key has another revision than the one that was to be replaced."""


class Stored(NamedTuple):
    """A record of the log: its sequence number, which counts from 1 without gaps, its id and its bytes."""

    seq: int
    id: str
    data: bytes


class Snapshot(NamedTuple):
    """A checkpoint: the sequence number of the newest record in it, and its bytes."""

    seq: int
    data: bytes


class Revised(NamedTuple):
    """A value of a key, with its revision."""

    value: bytes
    revision: int


class Reader(Protocol):
    """A stream of all records of the log from a sequence number on, in order, without gaps."""

    @property
    def waiting(self) -> int:
        """Number of records that have come and were not taken yet."""
        ...

    async def take(self, wait_s: float) -> Stored | None:
        """Returns the next record; None: there was none within the time.

        Raises:
            PurgedError: the log does not have it any more.
        """
        ...

    def close(self) -> None:
        """Ends the stream."""


class Bus(Protocol):
    """One world's part of a bus, and the keys of all worlds."""

    bytes_out: int
    """Bytes of batches and records that were sent."""
    bytes_in: int
    """Bytes of batches and records that were received."""

    def publish(self, batch: bytes) -> None:
        """Sends a batch to the sequencer. It may be lost; the edge then sends it again."""

    async def receive(self, take: Callable[[bytes], None]) -> None:
        """Calls a function with each batch from now on."""

    async def append(self, entry: Entry) -> int:
        """Appends a record to the log. Returns its sequence number. Accepts a record again that the log has.

        Raises:
            RefusedError: the record does not follow the newest one.
            BusError: there was no answer.
        """
        ...

    async def end(self) -> tuple[int, str]:
        """Returns sequence number and id of the newest record; 0 and empty: there is none.

        Raises:
            BusError: there was no answer.
        """
        ...

    async def follow(self, seq: int) -> Reader:
        """Returns a stream of all records from a sequence number on."""
        ...

    async def checkpoint(self) -> Snapshot | None:
        """Returns the newest checkpoint; None: there is none."""
        ...

    async def put_checkpoint(self, snapshot: Snapshot, keep: int) -> None:
        """Saves a checkpoint. Then drops the log up to `keep` records before it, and older checkpoints."""

    async def get(self, key: str) -> Revised | None:
        """Returns the value of a key; None: it has none."""
        ...

    async def all(self, prefix: str) -> dict[str, Revised]:
        """Returns the values of all keys with a prefix.

        Raises:
            BusError: there was no answer.
        """
        ...

    async def put(self, key: str, value: bytes, revision: int | None = None) -> int:
        """Sets the value of a key. Returns its new revision.

        Args:
            key: the key: letters, digits, `-`, `_` and `.`.
            value: the value.
            revision: the revision that it replaces; 0: the key has no value yet; None: any.

        Raises:
            ConflictError: the key has another revision.
        """
        ...

    async def delete(self, key: str, revision: int | None = None) -> None:
        """Removes the value of a key.

        Args:
            key: the key.
            revision: the revision that is removed; None: any.

        Raises:
            ConflictError: the key has another revision.
        """

    def watch(self, prefix: str) -> AsyncIterator[tuple[str, Revised | None]]:
        """Yields all keys with a prefix and their values, then each change; None: the value was removed."""
        ...

    async def close(self) -> None:
        """Ends the connection to the bus."""
