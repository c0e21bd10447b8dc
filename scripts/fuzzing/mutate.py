"""Mutations of messages into bytes that are nearly valid, where decoders are most likely to fail."""

import random
from collections.abc import Sequence
from typing import Any

import msgpack

HEADS = bytes((0x80, 0x8F, 0x90, 0x94, 0x9F, 0xA0, 0xBF, 0xC0, 0xC1, 0xC2, 0xC4, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD))
HEADS += bytes((0xCE, 0xCF, 0xD0, 0xD1, 0xD3, 0xD4, 0xD9, 0xDB, 0xDC, 0xDD, 0xDE, 0xDF, 0xE0, 0xFF, 0x00, 0x7F))
"""First bytes of values in MessagePack."""
ODD: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 127, 128, 255, 256, 1 << 31, (1 << 32) - 1, 1 << 53, (1 << 63) - 1, (1 << 64) - 1),
    *(-(1 << 63), 0.0, -0.0, 1e300, -1e300, 5e-324, float("inf"), float("nan"), "", "\0", "é" * 40, b"", bytes(3)),
    *(b"\xff" * 33, bytes(1100), [], [[]], [0] * 9, {}, {"": b""}, {"edit": [1, 2, 3]}, {"a": {"b": {"c": []}}}),
)
WORDS: tuple[bytes, ...] = tuple(msgpack.packb(value) for value in ODD)
LONGEST = 12_000


def mutated(data: bytes, corpus: Sequence[bytes], rng: random.Random) -> bytes:
    """Returns a changed copy of at most `LONGEST` bytes. In a quarter of the cases, a value changes as well."""
    if rng.random() < 0.25:
        data = _value_changed(data, rng)
    below = rng.random
    for _ in range(1 + int(below() * below() * 4)):
        n = len(data)
        at = int(below() * n) if n else 0
        what = int(below() * 8)
        if what == 0 and n:
            data = data[:at] + bytes((data[at] ^ 1 << int(below() * 8),)) + data[at + 1 :]
        elif what == 1:
            data = data[:at] + HEADS[int(below() * len(HEADS)) :][:1] + data[at + 1 :]
        elif what == 2:
            data = data[:at] + bytes((int(below() * 256),)) + data[at:]
        elif what == 3:
            data = data[:at] + data[at + 1 + int(below() * 4) :]
        elif what == 4:
            data = data[:at]
        elif what == 5:
            data = data[:at] + data[at:][: int(below() * 40)] * (1 + int(below() * 3)) + data[at:]
        elif what == 6:
            other = corpus[int(below() * len(corpus))]
            data = data[:at] + other[int(below() * len(other)) :]
        else:
            data = data[:at] + WORDS[int(below() * len(WORDS))] + data[at + int(below() * 3) :]
    return data[:LONGEST]


def _value_changed(data: bytes, rng: random.Random) -> bytes:
    """Replaces one field of a message, or a value within it, by an unusual value."""
    try:
        value = msgpack.unpackb(data, strict_map_key=False)
        if type(value) is not list or not value:
            return data
        holder = value
        while True:
            at = rng.randrange(len(holder))
            if type(holder[at]) is not list or not holder[at] or rng.random() < 0.2:
                break
            holder = holder[at]
        if rng.random() < 0.1:
            del holder[at]
        else:
            old = holder[at]
            near = type(old) is int and rng.random() < 0.5
            holder[at] = old + rng.choice((-1, 1, -256, 1 << 16)) if near else rng.choice(ODD)
        return msgpack.packb(value)  # type: ignore[no-any-return]
    except Exception:  # these bytes are not a message, so they have no values to change
        return data
