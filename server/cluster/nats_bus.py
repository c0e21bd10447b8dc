"""The bus on NATS with JetStream: the only module that uses nats-py.

Theory of operation. A world has a stream `WORLD_name` with the subject `world.name.log`. The server of the bus
accepts a record only behind the one that its header names (`Nats-Expected-Last-Msg-Id`). It republishes what it has
accepted to `world.name.told`, which a part subscribes to: a subscription of the stream's own subject would also show
what was refused. A part finds missing records by their sequence numbers, and fetches them. Batches go over
`world.name.in` without the stream. Checkpoints are in the object store `CHECKPOINTS_name`; the key `name.checkpoint`
names the newest, `name.checkpoints` all that were begun since. Keys of all worlds are in the bucket `worlds`, whose
server republishes each stored change of a key to `worlds.told.key` for those who watch it.
"""

import asyncio
import contextlib
import json
import re
import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import nats
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error as NatsError
from nats.js import JetStreamContext
from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy, Header, ObjectStoreConfig, RePublish, StreamConfig
from nats.js.errors import APIError, KeyNotFoundError, KeyWrongLastSequenceError, NotFoundError
from nats.js.kv import KeyValue

from server.cluster.bus import BusError, ConflictError, PurgedError, RefusedError, Revised, Snapshot, Stored
from server.cluster.log_reader import LogReader
from server.cluster.watched import Watched, said
from server.scale.writer import EMPTY, Entry

ACK_S = 0.5
"""Seconds to wait for the acknowledgement of a record."""
ANSWER_S = 2.0
"""Seconds to wait for other answers."""
LIST_S = 10.0
"""Seconds after which all watched keys are read again."""
CONNECT_S = 5.0
"""Seconds to wait for a connection at the start."""
RECONNECT_S = 0.1
"""Seconds between two attempts to reconnect."""
ONE_BY_ONE = 16
"""Number of missing records from which they are fetched by a consumer."""
ATTEMPTS = 20
"""Attempts to fetch a record that the stream has, and that did not come."""
WRONG_LAST_ID, NAME_IN_USE, WRONG_LAST_SEQUENCE = 10070, 10058, 10071
"""Error codes of JetStream: another newest id; a stream of that name is set up otherwise; another newest revision."""
WORLD = re.compile("[A-Za-z0-9_-]{1,32}")
"""Pattern of the name of a world on the bus."""
BUCKET = "worlds"
"""Name of the bucket of keys."""
TOLD = RePublish(src=f"$KV.{BUCKET}.>", dest=f"{BUCKET}.told.>")
"""Subjects under which changes of keys are sent again once they are stored."""


class NatsBus:
    """One world's part of a NATS server. Create it with `NatsBus.connect`."""

    def __init__(self, client: Client, connection: Watched, world: str) -> None:
        self._client, self._connection, self._world = client, connection, world
        self._js: JetStreamContext = client.jetstream(timeout=ANSWER_S)
        self._stream, self._subject = f"WORLD_{world}", f"world.{world}"
        self._kv: KeyValue | None = None
        self._store: Any = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.bytes_out = self.bytes_in = 0

    @classmethod
    async def connect(cls, url: str, world: str, *, replicas: int = 1, log: bool = True) -> "NatsBus":
        """Connects to a NATS server, and makes the stream and the stores of a world if they do not exist.

        Args:
            url: address, nats://HOST:PORT; several are separated by commas.
            world: name of the world.
            replicas: number of servers that store the log, the checkpoints and the keys.
            log: whether the world has a log and checkpoints; otherwise only the keys can be used.

        Raises:
            BusError: there is no connection, or the server has no JetStream.
        """
        if not WORLD.fullmatch(world):
            raise BusError(f"world = {world!r}: must be 1 to 32 letters, digits, - and _")
        connection = Watched()
        try:
            client = await asyncio.wait_for(
                nats.connect(
                    url.split(","),
                    name=f"sovereign {world}",
                    max_reconnect_attempts=-1,
                    reconnect_time_wait=RECONNECT_S,
                    connect_timeout=2,
                    ping_interval=2,
                    error_cb=connection.failed,
                    disconnected_cb=connection.lost,
                    reconnected_cb=connection.back,
                ),
                CONNECT_S,
            )
        except (NatsError, OSError, TimeoutError) as error:
            raise BusError(f"bus = {url!r}: no connection ({said(error)})") from error
        bus = cls(client, connection, world)
        try:
            await bus._prepare(replicas, log)
        except (NatsError, OSError, TimeoutError) as error:
            await client.close()
            raise BusError(f"bus = {url!r}: cannot be used; is JetStream on (-js)? ({said(error)})") from error
        return bus

    async def _prepare(self, replicas: int, log: bool) -> None:
        with _unless(NAME_IN_USE):
            await self._js.create_key_value(bucket=BUCKET, history=1, replicas=replicas, republish=TOLD)
        bucket = (await self._js.stream_info(f"KV_{BUCKET}")).config
        if bucket.republish is None:  # an earlier version made it
            bucket.republish = TOLD
            await self._js.update_stream(bucket)
        self._kv = await self._js.key_value(BUCKET)
        if not log:
            return
        config = StreamConfig(
            name=self._stream,
            subjects=[f"{self._subject}.log"],
            republish=RePublish(src=f"{self._subject}.log", dest=f"{self._subject}.told"),
            allow_direct=True,
            num_replicas=replicas,
        )
        with _unless(NAME_IN_USE):
            await self._js.add_stream(config)
        with _unless(NAME_IN_USE):
            name = f"CHECKPOINTS_{self._world}"
            await self._js.create_object_store(name, config=ObjectStoreConfig(bucket=name, replicas=replicas))
        self._store = await self._js.object_store(f"CHECKPOINTS_{self._world}")

    # -- batches -----------------------------------------------------------------------------------------------

    def publish(self, batch: bytes) -> None:
        if self._client.is_connected:
            self.bytes_out += len(batch)
            self._begin(self._client.publish(f"{self._subject}.in", batch))

    async def receive(self, take: Callable[[bytes], None]) -> None:
        async def handle(message: Msg) -> None:
            self.bytes_in += len(message.data)
            take(message.data)

        await self._client.subscribe(f"{self._subject}.in", cb=handle)

    # -- the log -----------------------------------------------------------------------------------------------

    async def append(self, entry: Entry) -> int:
        headers = {Header.MSG_ID.value: entry.id}
        if entry.after != EMPTY:
            headers[Header.EXPECTED_LAST_MSG_ID.value] = entry.after
        else:
            headers[Header.EXPECTED_LAST_SEQUENCE.value] = "0"
        self.bytes_out += len(entry.data)
        try:
            answer = await self._client.request(f"{self._subject}.log", entry.data, timeout=ACK_S, headers=headers)
            told: dict[str, Any] = json.loads(answer.data)
        except (NatsError, OSError, ValueError) as error:
            raise BusError(f"no acknowledgement ({said(error)})") from error
        error_code = told.get("error", {}).get("err_code")
        if error_code is None:
            return int(told["seq"])
        if error_code == WRONG_LAST_ID or entry.after == EMPTY:
            seq, last = await self.end()
            if last == entry.id:  # it was stored before, and only its acknowledgement was lost
                return seq
            raise RefusedError(last)
        raise BusError(f"not stored ({told['error'].get('description', error_code)})")

    async def end(self) -> tuple[int, str]:
        try:
            message = await self._js.get_last_msg(self._stream, f"{self._subject}.log")
        except NotFoundError:
            return 0, EMPTY
        except (NatsError, OSError, TimeoutError) as error:
            raise BusError(said(error)) from error
        return message.seq or 0, _id_of(message.headers)

    async def follow(self, seq: int) -> LogReader:
        reader = LogReader(self, seq)

        async def take(message: Msg) -> None:
            self.bytes_in += len(message.data)
            number = int((message.headers or {}).get("Nats-Sequence", 0))
            reader.come(Stored(number, _id_of(message.headers), message.data))

        subscription = await self._client.subscribe(f"{self._subject}.told", cb=take)
        reader.on_close = lambda: self._begin(subscription.unsubscribe())
        return reader

    async def fetch(self, first: int, last: int) -> list[Stored]:
        """Returns records of the stream by their sequence numbers.

        Raises:
            PurgedError: the stream does not have the first one any more.
            BusError: there was no answer.
        """
        try:
            if last - first >= ONE_BY_ONE:
                return await self._fetch_many(first, last)
            found = await asyncio.gather(*(self._stored(seq) for seq in range(first, last + 1)))
        except NotFoundError as error:
            info = await self._js.stream_info(self._stream)
            if first < info.state.first_seq:
                raise PurgedError(f"record {first} is not in the log any more") from error
            raise BusError("a record is missing") from error
        except (NatsError, OSError, TimeoutError) as error:
            raise BusError(said(error)) from error
        return found

    async def _fetch_many(self, first: int, last: int) -> list[Stored]:
        """Returns records by a consumer of the stream, or only the first ones of them."""
        config = ConsumerConfig(
            deliver_policy=DeliverPolicy.BY_START_SEQUENCE,
            opt_start_seq=first,
            ack_policy=AckPolicy.NONE,
            inactive_threshold=2 * ANSWER_S,
        )
        subject = f"{self._subject}.log"
        subscription = await self._js.pull_subscribe(subject, stream=self._stream, config=config)
        try:
            messages = await subscription.fetch(last - first + 1, timeout=ANSWER_S)
        finally:
            await subscription.unsubscribe()
        found = [
            Stored(message.metadata.sequence.stream, _id_of(message.headers), message.data) for message in messages
        ]
        self.bytes_in += sum(len(stored.data) for stored in found)
        if found and found[0].seq > first:
            raise PurgedError(f"record {first} is not in the log any more")
        return found

    async def _stored(self, seq: int) -> Stored:
        message = await self._js.get_msg(self._stream, seq=seq, direct=True)
        self.bytes_in += len(message.data or b"")
        return Stored(seq, _id_of(message.headers), message.data or b"")

    # -- checkpoints -------------------------------------------------------------------------------------------

    async def checkpoint(self) -> Snapshot | None:
        for _ in range(ATTEMPTS):
            known = await self.get(f"{self._world}.checkpoint")
            if known is None:
                return None
            named = json.loads(known.value)
            try:
                return Snapshot(named["seq"], (await self._store.get(named["object"])).data or b"")
            except NotFoundError:  # a newer one has replaced it
                await asyncio.sleep(RECONNECT_S)
            except (NatsError, OSError, TimeoutError) as error:
                raise BusError(said(error)) from error
        raise BusError("the newest checkpoint cannot be found")

    async def put_checkpoint(self, snapshot: Snapshot, keep: int) -> None:
        key = f"{self._world}.checkpoint"
        known = await self.get(key)
        former = {"seq": 0} if known is None else json.loads(known.value)
        if former["seq"] >= snapshot.seq:
            return
        name, begun = f"{snapshot.seq}-{secrets.token_hex(8)}", f"{self._world}.checkpoints"
        listed = await self.get(begun)
        others = [] if listed is None else json.loads(listed.value)  # with those of parts that were killed meanwhile
        await self.put(begun, json.dumps([*others, name]).encode())
        await self._store.put(name, snapshot.data)
        value = json.dumps({"object": name, "seq": snapshot.seq}).encode()
        try:
            await self.put(key, value, 0 if known is None else known.revision)
        except ConflictError:
            others = [name]
        for other in others:
            with contextlib.suppress(NotFoundError):
                await self._store.delete(other)
        if name in others:
            return
        await self.put(begun, json.dumps([name]).encode())
        await self._js.purge_stream(self._stream, seq=max(snapshot.seq - keep, 1))

    # -- keys --------------------------------------------------------------------------------------------------

    async def get(self, key: str) -> Revised | None:
        assert self._kv is not None
        try:
            entry = await self._kv.get(key)
        except KeyNotFoundError:
            return None
        except (NatsError, OSError, TimeoutError) as error:
            raise BusError(said(error)) from error
        return Revised(entry.value or b"", entry.revision or 0)

    async def all(self, prefix: str) -> dict[str, Revised]:
        values = {}
        for key in await self._keys(prefix):
            value = await self.get(key)
            if value is not None:
                values[key] = value
        return values

    async def put(self, key: str, value: bytes, revision: int | None = None) -> int:
        assert self._kv is not None
        try:
            if revision is None:
                return await self._kv.put(key, value)
            if revision == 0:
                return await self._kv.create(key, value)
            return await self._kv.update(key, value, last=revision)
        except KeyWrongLastSequenceError as error:
            raise ConflictError(f"{key}: has another revision than {revision}") from error
        except (NatsError, OSError, TimeoutError) as error:
            raise BusError(said(error)) from error

    async def delete(self, key: str, revision: int | None = None) -> None:
        headers = {"KV-Operation": "DEL"}
        if revision is not None:
            headers[Header.EXPECTED_LAST_SUBJECT_SEQUENCE.value] = str(revision)
        try:
            await self._js.publish(f"$KV.{BUCKET}.{key}", headers=headers)
        except (NatsError, OSError, TimeoutError) as error:
            if isinstance(error, APIError) and error.err_code == WRONG_LAST_SEQUENCE:
                raise ConflictError(f"{key}: has another revision than {revision}") from error
            raise BusError(said(error)) from error

    async def watch(self, prefix: str) -> AsyncIterator[tuple[str, Revised | None]]:
        head, changed = f"{BUCKET}.told.", asyncio.Queue[str]()
        known: dict[str, Revised] = {}

        async def note(message: Msg) -> None:
            if (key := message.subject.removeprefix(head)).startswith(prefix):
                changed.put_nowait(key)

        subscription = await self._client.subscribe(f"{head}{prefix}>" if prefix.endswith(".") else f"{head}>", cb=note)
        try:
            listed_at, listed_after = -LIST_S, 0
            while True:
                times = self._connection.times_back  # changes may have been missed during a reconnect
                if time.monotonic() - listed_at > LIST_S or times != listed_after:
                    with contextlib.suppress(BusError):
                        for key in {*await self._keys(prefix), *known}:
                            changed.put_nowait(key)
                        listed_at, listed_after = time.monotonic(), times
                try:
                    key = await asyncio.wait_for(changed.get(), ANSWER_S)
                except TimeoutError:
                    continue
                try:
                    found = await self.get(key)
                except BusError:
                    changed.put_nowait(key)
                    await asyncio.sleep(RECONNECT_S)
                    continue
                if known.get(key) != found:
                    known.pop(key, None)
                    if found is not None:
                        known[key] = found
                    yield key, found
        finally:
            with contextlib.suppress(NatsError):
                await subscription.unsubscribe()

    async def _keys(self, prefix: str) -> list[str]:
        head = f"$KV.{BUCKET}."
        try:
            info = await self._js.stream_info(f"KV_{BUCKET}", subjects_filter=f"{head}>")
        except (NatsError, OSError, TimeoutError) as error:
            raise BusError(said(error)) from error
        subjects = [subject.removeprefix(head) for subject in info.state.subjects or {}]
        return [key for key in subjects if key.startswith(prefix)]

    # -- the connection ----------------------------------------------------------------------------------------

    async def close(self) -> None:
        self._connection.closing = True
        with contextlib.suppress(NatsError, TimeoutError, OSError):
            await asyncio.wait_for(self._client.close(), ANSWER_S)

    def _begin(self, sending: Any) -> None:
        async def sent() -> None:
            with contextlib.suppress(NatsError, OSError):
                await sending

        task = asyncio.get_running_loop().create_task(sent())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


@contextlib.contextmanager
def _unless(code: int) -> Iterator[None]:
    """Ignores an error of JetStream by its code."""
    try:
        yield
    except APIError as error:
        if error.err_code != code:
            raise


def _id_of(headers: Any) -> str:
    return str((headers or {}).get(Header.MSG_ID.value, EMPTY))
