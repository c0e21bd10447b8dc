"""A core with a server that sends wrong times and a program that misuses it, by a simulated clock."""

import math
from typing import Any

import msgpack
import numpy as np
import pytest

from client_sdk.core import Core
from client_sdk.events import Joined, Left
from client_sdk.timing.server_clock import PINGS
from shared import messages
from shared.blocks import pack
from shared.bounds import bounds
from shared.messages import Pong, Snapshot, Terrain, Welcome, decode_from_client, encode
from shared.snapshot import encode_part
from shared.world import World
from tests.worlds import scene

ME = 1
HERE = (0, 0, 0)
NOW = 100.0
SCENE = scene([[0, 0, 0, 32, 32, 1, 1]], origin=(0, 0, 0), size=(1, 1, 1), spawns=((16.0, 16.0, 1.0),))
WORLD = World(SCENE, compiled=False)
WORLD.load_terrain()
WORLD.spawn("box", (16, 16, 1))


def snapshot(tick: int, ago: int = 1) -> bytes:
    """Returns a snapshot of the world: complete if `ago` is negative, otherwise without any change."""
    rows = WORLD.in_segment(HERE) if ago < 0 else WORLD.in_segment(HERE)[:0]
    part = msgpack.unpackb(encode_part(HERE, ago, rows))
    return encode(Snapshot(tick, -1, b"", 0, b"", b"", b"", (part,)))


def terrain(segment: tuple[int, int, int] = HERE, **changes: Any) -> bytes:
    packed = pack(WORLD.blocks.segment(HERE).reshape(-1))
    return encode(Terrain(*segment, 0, len(packed), packed)._replace(**changes))


class Served:
    """A core that was welcomed at tick 10, with a server whose time is off by `off` ticks."""

    def __init__(self, off: float = 0.0, tick: int = 10, **options: Any) -> None:
        self.core = Core("Ann", compiled=False, **options)
        self.off = off
        self.now = NOW
        self.core.open(NOW)
        self.core.receive(encode(Welcome(messages.VERSION, tick, ME, SCENE.to_table(), bytes(16))), NOW)
        self.core.receive(terrain(), NOW)
        self.core.receive(snapshot(tick, -1), NOW)
        for _ in range(PINGS):
            self.live(0.25)

    @property
    def tick(self) -> float:
        return 10 + (self.now - NOW) * SCENE.tick_rate + self.off

    def live(self, seconds: float) -> list[messages.Message]:
        """Lets `seconds` pass and updates. Returns the messages sent. Pings are answered at once."""
        self.now += seconds
        self.core.update(self.now)
        sent = [decode_from_client(message) for message in self.core.outgoing()]
        for message in sent:
            if isinstance(message, messages.Ping):
                self.core.receive(encode(Pong(message.sent, self.tick)), self.now)
        return sent


@pytest.mark.parametrize("off", [1e6, 1e15, 1e300, -1e300])
def test_with_any_server_time_few_ticks_are_replayed(off: float) -> None:
    served = Served(off)
    served.live(0.25)
    assert Joined in [type(event) for event in served.core.events()]
    prediction = served.core.prediction
    assert prediction is not None
    assert (
        prediction.confirmed.tick
        <= prediction.predicted.tick
        <= prediction.confirmed.tick + bounds(SCENE.tick_rate).unconfirmed
    )
    for tick in range(11, 60):
        served.core.receive(snapshot(tick), served.now)
        served.live(1 / SCENE.tick_rate)
        served.core.view(served.now)
    assert prediction.predicted.tick <= prediction.confirmed.tick + bounds(SCENE.tick_rate).unconfirmed


def test_a_program_that_was_away_for_long_is_not_woken_before_something_comes() -> None:
    served = Served()
    for tick in range(11, 20):
        served.core.receive(snapshot(tick), served.now)
        served.live(1 / SCENE.tick_rate)
    assert served.core.state == "playing"
    served.live(60.0)
    wakes = 0
    until = served.now + 5
    while served.now < until:
        wakes += 1
        due = served.core.next_update(served.now)
        assert due > served.now
        served.live(due - served.now)
    assert wakes <= 7  # one wake-up per second for a ping


def test_nothing_is_sent_after_the_end() -> None:
    served = Served()
    served.core.close()
    assert [type(decode_from_client(message)) for message in served.core.outgoing()] == [messages.Bye]
    for _ in range(5):
        assert served.live(1.0) == []
    assert served.core.next_update(served.now) == math.inf
    served.core.open(served.now)  # a connection that was under way
    assert served.core.outgoing() == []


def test_terrain_outside_of_the_scene_is_refused() -> None:
    served = Served()
    served.core.receive(terrain((1, 0, 0)), served.now)
    left = served.core.events()[-1]
    assert isinstance(left, Left)
    assert left.code == messages.MALFORMED
    assert "the scene has no segment (1, 0, 0)" in left.reason


def test_what_cannot_be_sent_is_not_predicted() -> None:
    served = Served()
    served.core.receive(snapshot(int(served.tick)), served.now)
    served.live(1 / SCENE.tick_rate)
    core = served.core
    assert core.prediction is not None
    for wrong in (16.5, "x", 1 << 70):
        with pytest.raises((TypeError, OverflowError)):
            core.edit(wrong, 16, 2, 1)  # type: ignore[arg-type]
    served.live(1 / SCENE.tick_rate)
    assert core.edit(np.int64(17), np.int64(18), 1, 1) == 1
    sent = served.live(1 / SCENE.tick_rate)
    assert [message.number for message in sent if isinstance(message, messages.Command)] == [1]
    assert core.prediction.predicted.blocks.get(17, 18, 1) == 1


def test_edits_that_arrive_between_pieces_of_a_segment_are_in_it() -> None:
    served = Served()
    packed = pack(WORLD.blocks.segment(HERE).reshape(-1))
    served.core.receive(terrain(chunk=packed[:10]), served.now)
    for tick, kind in ((11, 5), (12, 6)):
        part = msgpack.unpackb(encode_part(HERE, 1, WORLD.in_segment(HERE)[:0], edits=[(1 << 10, kind)]))
        served.core.receive(encode(Snapshot(tick, -1, b"", 0, b"", b"", b"", (part,))), served.now)
    served.core.receive(terrain(offset=10, chunk=packed[10:]), served.now)
    assert served.core.prediction is not None
    assert served.core.prediction.confirmed.blocks.get(0, 0, 1) == 6
