"""The model of a TCP connection compared with measurements and with the promises of TCP."""

import heapq
from collections.abc import Callable
from dataclasses import replace
from itertools import count

import pytest

from client_sdk.netsim.links import PRESETS, Link, LinkEvents, TcpStream
from tests.lengths import long


class Time:
    """The smallest possible scheduler."""

    def __init__(self) -> None:
        self.now = 0.0
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._number = count()

    def at(self, when: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (when, next(self._number), act))

    def run(self, until: float) -> None:
        while self._queue and self._queue[0][0] <= until:
            self.now, _, act = heapq.heappop(self._queue)
            act()
        self.now = until


class Stream:
    """Messages that are sent at a steady rate, and the time of arrival of each."""

    def __init__(self, path: Link, hz: float, size: int, messages: int, seed: int = 1) -> None:
        time = Time()
        self.arrivals: list[float] = []
        self.order: list[int] = []
        self.delays: list[float] = []

        def deliver(message: bytes) -> None:
            number = int.from_bytes(message[:4], "big")
            self.order.append(number)
            self.arrivals.append(time.now)
            self.delays.append(time.now - number / hz)

        self.wire = TcpStream(time, LinkEvents(path, seed), seed, deliver)
        for number in range(messages):
            time.run(number / hz)
            self.wire.send(number.to_bytes(4, "big") + bytes(size - 4))
        time.run(messages / hz + 120)

    def share_later_than(self, delay_s: float) -> float:
        return sum(delay > delay_s for delay in self.delays) / len(self.delays)


@pytest.mark.parametrize(
    ("hz", "rtt_s", "loss", "published"),
    [
        (20, 0.050, 0.010, 0.0100),
        *long(
            (60, 0.050, 0.005, 0.0),
            (20, 0.120, 0.010, 0.0200),
            (20, 0.050, 0.005, 0.0097),
            (20, 0.050, 0.020, 0.0250),
            (60, 0.050, 0.010, 0.0006),
            (60, 0.050, 0.020, 0.0034),
            (60, 0.120, 0.010, 0.0370),
        ),
    ],
)
def test_head_of_line_stalls_are_as_measured(hz: int, rtt_s: float, loss: float, published: float) -> None:
    """Measured with 400-byte messages: the share that is more than 100 ms late. The model is within a factor of two."""
    share = Stream(Link(rtt_s / 2, 0.0, loss), hz, 400, 60_000).share_later_than(rtt_s / 2 + 0.1)
    if published:
        assert published / 2 <= share <= published * 2
    else:
        assert share <= 0.001


@pytest.mark.parametrize("name", PRESETS)
def test_everything_comes_once_in_order_and_is_acknowledged(name: str) -> None:
    stream = Stream(PRESETS[name], 32, 60, 2000)
    assert stream.order == list(range(2000))
    assert stream.arrivals == sorted(stream.arrivals)
    assert stream.wire.outstanding() == 0


def test_one_seed_is_one_run() -> None:
    runs = [Stream(PRESETS["typical"], 32, 60, 500, seed).arrivals for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]


def test_a_loss_stalls_what_follows_and_then_all_comes_at_once() -> None:
    stream = Stream(Link(0.05, 0.0, 0.01), 32, 60, 4000)
    bursts = [stream.arrivals.count(at) for at in set(stream.arrivals)]
    assert max(bursts) >= 5
    stalls = sorted(delay for delay in stream.delays if delay > 0.06)
    gap_s = 1 / 32
    assert 0.05 + gap_s + 0.125 <= stalls[len(stalls) * 9 // 10] <= 0.05 + gap_s + 0.150


def test_the_last_message_is_saved_by_the_time_out() -> None:
    delays = {round(Stream(Link(0.02, 0.0, 0.3), 32, 60, 1, seed).delays[0], 4) for seed in range(50)}
    assert {0.02, 0.02 + 0.24, 0.02 + 0.24 + 0.48} <= {round(delay, 2) for delay in delays}


def test_the_line_takes_its_time_and_queues() -> None:
    stream = Stream(Link(0.0, rate=80e3), 32, 400, 100)
    alone = 8 * (400 + 6 + 66) / 80e3
    assert stream.delays[0] == pytest.approx(alone)
    assert stream.arrivals[-1] == pytest.approx(100 * alone)


def test_outstanding_counts_what_is_not_acknowledged() -> None:
    time = Time()
    wire = TcpStream(time, LinkEvents(Link(0.1), 1), 1, lambda message: None)
    wire.send(bytes(94))
    assert wire.outstanding() == 100
    time.run(0.19)
    assert wire.outstanding() == 100
    time.run(0.21)
    assert wire.outstanding() == 0


def test_packets_on_a_wire_that_is_cut_never_arrive() -> None:
    time, got = Time(), list[bytes]()
    wire = TcpStream(time, LinkEvents(Link(0.1), 1), 1, got.append)
    wire.send(b"before")
    time.run(0.11)
    wire.send(b"on the way")
    wire.cut()
    wire.send(b"after")
    time.run(1.0)
    assert got == [b"before"]


def test_waiting_messages_are_listed_in_order_with_any_losses() -> None:
    for seed in range(20):
        time, got = Time(), list[bytes]()
        wire = TcpStream(time, LinkEvents(Link(0.02, 0.01, 0.3), 1), seed, got.append)
        sent = [bytes((number,)) * (1 if number % 5 else 3000) for number in range(40)]
        for number, message in enumerate(sent):
            time.run(number / 100)
            wire.send(message)
            assert got + wire.waiting() == sent[: number + 1]
            assert wire.idle == (not wire.waiting())
        time.run(30)
        assert got == sent
        assert wire.idle


def test_a_dip_narrows_the_line_for_its_time() -> None:
    link_events = LinkEvents(PRESETS["dip"], 1)
    assert [link_events.rate(at) for at in (0.0, 29.9, 30.1, 39.9, 40.1)] == [2e6, 2e6, 120e3, 120e3, 2e6]
    assert link_events.dipped(31.0) == pytest.approx(1.0)
    assert link_events.dipped(29.0) < 0


def test_spikes_are_the_same_for_both_directions_and_last_about_a_second() -> None:
    first, second = LinkEvents(PRESETS["wifi"], 5), LinkEvents(PRESETS["wifi"], 5)
    seen = [first.extra(at / 100) for at in range(60_000)]
    assert seen == [second.extra(at / 100) for at in range(60_000)]
    assert 40 <= len(first.spikes) <= 70
    lengths = [end - begin for begin, end, _ in first.spikes]
    assert 0.7 <= min(lengths) <= max(lengths) <= 1.3
    path = PRESETS["wifi"]
    assert 0.130 < path.rtt_s + 2 * max(seen) <= 0.151


def test_messages_sent_during_an_outage_arrive_after_it() -> None:
    path = replace(Link(0.02), outage=(3.0, 0.12))
    stream = Stream(path, 32, 60, 320)
    worst = max(stream.delays)
    assert 0.12 < worst < 0.3
    assert 3 * 4 <= sum(delay > 0.03 for delay in stream.delays) <= 3 * 8  # three outages
