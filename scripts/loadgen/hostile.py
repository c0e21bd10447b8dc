"""Hostile peers in one process, for `soak.py` and the torture tests. They attack only a server on this machine.

argument  {"port", "seed", "peers": {attack: number at a time}, "connects_per_s"}, as JSON
stdin     its end: stop
stdout    one JSON object at the end: how often each attack was made

Each peer repeats its attack, however the server reacts.
"""

import asyncio
import contextlib
import json
import logging
import os
import random
import socket
import struct
import sys
from collections import Counter
from collections.abc import Awaitable, Callable

from scripts.loadgen.player import REQUEST, frame
from shared import messages
from shared.fields import CLIENT_MESSAGE_MAX
from shared.messages import Command, Hello, Inputs, Ping, encode

PATIENCE_S = 8.0
"""Seconds after which a peer disconnects if the server has not ended its connection."""
AT_ONCE = struct.pack("ii", 1, 0)
"""Value of SO_LINGER with which closing a socket resets the connection."""
HELLO = frame(encode(Hello(messages.VERSION, {}, "rogue")))

Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]
Attack = Callable[[Streams, random.Random], Awaitable[None]]


async def nothing(streams: Streams, rng: random.Random) -> None:
    """Connects and sends nothing."""
    await streams[0].read(1 << 16)


async def half_a_request(streams: Streams, rng: random.Random) -> None:
    """Sends a part of the request, and never the rest."""
    streams[1].write(REQUEST[: rng.randrange(1, len(REQUEST))])
    await streams[0].read(1 << 16)


async def slow_loris(streams: Streams, rng: random.Random) -> None:
    """Sends the request slowly, byte by byte."""
    for at in range(len(REQUEST)):
        streams[1].write(REQUEST[at : at + 1])
        await asyncio.sleep(0.2)


async def never_reads(streams: Streams, rng: random.Random) -> None:
    """Plays, asks for answers, and reads nothing at all."""
    transport = streams[0]._transport  # type: ignore[attr-defined]  # asyncio offers no other way
    transport.pause_reading()
    transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    streams[1].write(REQUEST + HELLO)
    for at in range(1000):
        streams[1].write(frame(encode(Ping(at))))
        await streams[1].drain()
        await asyncio.sleep(0.02)


async def one_byte_a_second(streams: Streams, rng: random.Random) -> None:
    """Reads one byte per second, so that the server's messages pile up."""
    streams[1].write(REQUEST + HELLO)
    transport = streams[0]._transport  # type: ignore[attr-defined]
    transport.pause_reading()
    sock = transport.get_extra_info("socket")
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    for _ in range(60):
        with contextlib.suppress(BlockingIOError):
            if not os.read(sock.fileno(), 1):
                return
        streams[1].write(frame(encode(Inputs(1, -1, bytes(3)))))
        await asyncio.sleep(1.0)


async def mid_frame(streams: Streams, rng: random.Random) -> None:
    """Disconnects in the middle of a message."""
    message = frame(encode(Command(1, 5, 4.5, "edit", bytes(200))))
    streams[1].write(REQUEST + HELLO + message[: rng.randrange(1, len(message))])
    await asyncio.sleep(rng.uniform(0.0, 0.3))


async def rubbish(streams: Streams, rng: random.Random) -> None:
    """Sends random bytes, in well-formed frames or instead of frames."""
    data = rng.randbytes(rng.randrange(CLIENT_MESSAGE_MAX))
    streams[1].write(REQUEST + HELLO + (data if rng.random() < 0.5 else frame(data)))
    await streams[0].read(1 << 16)
    await asyncio.sleep(rng.uniform(0.0, 0.3))


async def flood(streams: Streams, rng: random.Random) -> None:
    """Sends 2000 messages at once."""
    streams[1].write(REQUEST + HELLO + frame(encode(Ping(1.0))) * 2000)
    await streams[0].read(1 << 16)
    await asyncio.sleep(rng.uniform(0.2, 0.5))


ATTACKS: dict[str, Attack] = {
    attack.__name__: attack
    for attack in (
        nothing,
        half_a_request,
        slow_loris,
        never_reads,
        one_byte_a_second,
        mid_frame,
        rubbish,
        flood,
    )
}


async def peer(attack: Attack, port: int, rng: random.Random, made: Counter[str]) -> None:
    """Makes an attack again and again, each on a new connection."""
    while True:
        await asyncio.sleep(rng.uniform(0.0, 0.3))
        with contextlib.suppress(OSError, TimeoutError):
            streams = await asyncio.open_connection("127.0.0.1", port, limit=1 << 16)
            made[attack.__name__] += 1
            try:
                async with asyncio.timeout(PATIENCE_S):
                    await attack(streams, rng)
            finally:
                streams[1].transport.abort()


async def connects(port: int, per_s: float, made: Counter[str]) -> None:
    """Makes connections at a steady rate and resets each at once.

    A machine that is too slow for the rate makes those of the last half second, and the task can still be cancelled.
    """
    loop = asyncio.get_running_loop()
    begun, n = loop.time(), 0
    while True:
        due = int((loop.time() - begun) * per_s)
        n = max(n, due - int(0.5 * per_s))  # connections that could not be made in time are skipped
        while n < due:
            n += 1
            with contextlib.suppress(OSError), socket.socket() as sock:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, AT_ONCE)
                sock.settimeout(0.05)
                sock.connect(("127.0.0.1", port))
                if n % 2:
                    sock.send(REQUEST)
                made["connects"] += 1
        await asyncio.sleep(0.005)


async def main(order: dict[str, object]) -> None:
    """Runs all peers until stdin ends, then prints the counts."""
    port, seed, peers, made = order["port"], order["seed"], order["peers"], Counter[str]()
    assert isinstance(port, int)
    assert isinstance(peers, dict)
    tasks = [
        asyncio.create_task(peer(ATTACKS[name], port, random.Random(f"{seed} {name} {i}"), made))
        for name, n in peers.items()
        for i in range(n)
    ]
    per_s = order.get("connects_per_s")
    if isinstance(per_s, int | float) and per_s > 0:
        tasks.append(asyncio.create_task(connects(port, per_s, made)))
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    for task in tasks:
        task.cancel()
    ended = await asyncio.gather(*tasks, return_exceptions=True)
    failed = [repr(error) for error in ended if not isinstance(error, asyncio.CancelledError)]
    print(json.dumps({"made": made, "failed": failed}), flush=True)


if __name__ == "__main__":
    logging.getLogger("asyncio").setLevel(logging.ERROR)  # lost connections are intended here
    asyncio.run(main(json.loads(sys.argv[1])))
