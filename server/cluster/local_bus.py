"""A bus within one process, for tests and for all parts of a world in one event loop.

hub = LocalHub()
bus = LocalBus(hub)                     # one for each part
"""

import asyncio
from collections.abc import AsyncIterator, Callable

from server.cluster.bus import ConflictError, PurgedError, RefusedError, Revised, Snapshot, Stored
from server.scale.writer import EMPTY, Entry


class LocalHub:
    """The log, the checkpoint and the keys that the buses of one process share."""

    def __init__(self) -> None:
        self.log: dict[int, Stored] = {}
        self.newest = Stored(0, EMPTY, b"")
        self.ids: dict[str, int] = {}
        self.checkpoint: Snapshot | None = None
        self.values: dict[str, Revised] = {}
        self.revision = 0
        self.takers: list[Callable[[bytes], None]] = []
        self.readers: list[LocalReader] = []
        self.watchers: list[tuple[str, asyncio.Queue[tuple[str, Revised | None]]]] = []

    def put(self, key: str, value: bytes | None, revision: int | None) -> int:
        """Sets the value of a key, or removes it. Returns the new revision. Arguments and errors as for `Bus.put`."""
        known = self.values.get(key)
        if revision is not None and revision != (0 if known is None else known.revision):
            raise ConflictError(f"{key}: has another revision than {revision}")
        self.revision += 1
        if value is None:
            self.values.pop(key, None)
        else:
            self.values[key] = Revised(value, self.revision)
        self.changed(key, self.values.get(key))
        return self.revision

    def changed(self, key: str, value: Revised | None) -> None:
        """Reports the new value of a key to those who watch it."""
        for prefix, queue in self.watchers:
            if key.startswith(prefix):
                queue.put_nowait((key, value))


class LocalReader:
    """A stream of the records of a hub."""

    def __init__(self, hub: LocalHub, seq: int) -> None:
        self._hub, self._seq = hub, seq
        self._news = asyncio.Event()
        hub.readers.append(self)

    @property
    def waiting(self) -> int:
        return self._hub.newest.seq - self._seq + 1

    def wake(self) -> None:
        """Notes that there is a further record."""
        self._news.set()

    async def take(self, wait_s: float) -> Stored | None:
        if not self.waiting:
            self._news.clear()
            try:
                await asyncio.wait_for(self._news.wait(), wait_s)
            except TimeoutError:
                return None
        if self._seq not in self._hub.log:
            raise PurgedError(f"record {self._seq} is not in the log any more")
        self._seq += 1
        return self._hub.log[self._seq - 1]

    def close(self) -> None:
        if self in self._hub.readers:
            self._hub.readers.remove(self)


class LocalBus:
    """The bus of one part.

    Args:
        hub: what all parts share.
    """

    def __init__(self, hub: LocalHub) -> None:
        self._hub = hub
        self.bytes_out = self.bytes_in = 0
        self._mine: list[Callable[[bytes], None]] = []

    def publish(self, batch: bytes) -> None:
        for take in self._hub.takers:
            asyncio.get_running_loop().call_soon(take, batch)

    async def receive(self, take: Callable[[bytes], None]) -> None:
        self._hub.takers.append(take)
        self._mine.append(take)

    async def append(self, entry: Entry) -> int:
        hub = self._hub
        if entry.id in hub.ids:
            return hub.ids[entry.id]
        if entry.after != hub.newest.id:
            raise RefusedError(hub.newest.id)
        hub.newest = Stored(hub.newest.seq + 1, entry.id, entry.data)
        hub.log[hub.newest.seq], hub.ids[entry.id] = hub.newest, hub.newest.seq
        for reader in hub.readers:
            reader.wake()
        return hub.newest.seq

    async def end(self) -> tuple[int, str]:
        return self._hub.newest.seq, self._hub.newest.id

    async def follow(self, seq: int) -> LocalReader:
        return LocalReader(self._hub, seq)

    async def checkpoint(self) -> Snapshot | None:
        return self._hub.checkpoint

    async def put_checkpoint(self, snapshot: Snapshot, keep: int) -> None:
        hub = self._hub
        if hub.checkpoint is None or snapshot.seq > hub.checkpoint.seq:
            hub.checkpoint = snapshot
            for seq in [seq for seq in hub.log if seq <= snapshot.seq - keep]:
                del hub.ids[hub.log.pop(seq).id]

    async def get(self, key: str) -> Revised | None:
        return self._hub.values.get(key)

    async def all(self, prefix: str) -> dict[str, Revised]:
        return {key: value for key, value in self._hub.values.items() if key.startswith(prefix)}

    async def put(self, key: str, value: bytes, revision: int | None = None) -> int:
        return self._hub.put(key, value, revision)

    async def delete(self, key: str, revision: int | None = None) -> None:
        if key in self._hub.values or revision:
            self._hub.put(key, None, revision)

    async def watch(self, prefix: str) -> AsyncIterator[tuple[str, Revised | None]]:
        queue: asyncio.Queue[tuple[str, Revised | None]] = asyncio.Queue()
        for key, value in self._hub.values.items():
            if key.startswith(prefix):
                queue.put_nowait((key, value))
        watcher = (prefix, queue)
        self._hub.watchers.append(watcher)
        try:
            while True:
                yield await queue.get()
        finally:
            self._hub.watchers.remove(watcher)

    async def close(self) -> None:
        for take in self._mine:
            self._hub.takers.remove(take)
        self._mine.clear()
