"""A core on a link of its own, by a clock of the tests, and once on a real socket."""

import asyncio
import math
import time
from collections.abc import Callable

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.client import Client
from client_sdk.core import READ_BYTES
from client_sdk.events import Happened, Joined, Left
from client_sdk.netsim.linked import SLOW_READ_BYTES, LinkedCore
from client_sdk.netsim.links import PRESETS, Path
from shared import messages
from shared.messages import Bye, Hello, Inputs, Ping, decode_from_client, encode
from shared.scene import load_scene
from tests.client_sdk.servers import real_server
from tests.lengths import long
from tests.match import Match, wander

FAR = Path(0.125)
SOON = 2**-20
"""A moment, exact in binary like the other times here."""


def linked(link: str | Path | None, now: float = 16.0) -> LinkedCore:
    core = LinkedCore("Ann")
    core.link = link
    core.open(now)
    return core


def told(number: int) -> bytes:
    return encode(messages.Happened(number, "told", messages.pack_value(None)))


def heard(core: LinkedCore) -> list[int]:
    return [event.tick for event in core.events() if isinstance(event, Happened)]


def test_without_a_link_nothing_waits() -> None:
    core = linked(None)
    assert len(core.outgoing()) == 1
    core.receive(told(1), 16.0)
    assert heard(core) == [1]
    assert core.appetite == READ_BYTES


def test_each_way_takes_as_long_as_the_path() -> None:
    core = linked(FAR)
    core.receive(told(1), 16.0)
    assert core.outgoing() == []
    assert core.next_update(16.0) == 16.125
    core.update(16.125 - SOON)
    assert core.outgoing() == []
    assert heard(core) == []
    core.update(16.125)
    assert [type(decode_from_client(message)) for message in core.outgoing()] == [Hello]
    assert heard(core) == [1]
    assert core.next_update(16.125) == math.inf


def test_a_message_takes_its_time_from_when_it_comes() -> None:
    core = linked(FAR)
    core.update(16.0)
    core.receive(told(1), 17.0)
    core.update(17.125 - SOON)
    assert heard(core) == []
    core.update(17.125)
    assert heard(core) == [1]


def test_what_is_under_way_stays_in_front_when_the_link_changes() -> None:
    core = linked(FAR)
    core.receive(told(1), 16.0)
    core.link = Path(0.0625)
    core.receive(told(2), 16.0)
    core.link = None
    core.receive(told(3), 16.0)
    core.update(16.125 - SOON)
    assert heard(core) == []
    core.update(16.125)
    assert heard(core) == [1, 2, 3]
    assert len(core.outgoing()) == 1
    core.update(16.25)
    core.receive(told(4), 16.25)
    assert heard(core) == [4]
    core.link = "far"
    core.receive(told(5), 16.25)
    core.update(16.3)
    assert heard(core) == []
    core.update(17.0)
    assert heard(core) == [5]


def test_the_end_is_heard_behind_what_came_before_it() -> None:
    core = linked(FAR)
    core.receive(encode(Bye(messages.FULL, "the server is full", -1.0)), 16.0)
    core.lost(1006, "gone", 16.0)
    core.update(16.125 - SOON)
    assert core.state == "joining"
    core.update(16.125)
    assert core.events() == [Left(messages.FULL, "the server is full")]


def test_what_was_on_a_lost_line_is_gone() -> None:
    match = Match(load_scene("flat"), 1)
    core = LinkedCore(patience_s=10)
    player = match.join(wander, Path(), core)
    match.run_until(lambda: core.state == "playing", 10)
    core.link = FAR
    match.run(1)
    match.game.lost(player.session, match.now)  # type: ignore[arg-type]
    now = player.local
    core.lost(1006, "gone", now)
    assert core.state == "playing", "it does not know yet"
    core.update(now + 1)
    assert core.state == "away"
    core.open(now + 1)
    assert core.outgoing() == []
    core.update(now + 1.125 - SOON)
    assert core.outgoing() == []
    core.update(now + 1.125 + SOON)
    kinds = [type(decode_from_client(message)) for message in core.outgoing()]
    assert kinds[0] is Hello
    assert Inputs not in kinds
    assert set(kinds) <= {Hello, Ping}


def test_the_goodbye_does_not_wait() -> None:
    core = linked(FAR)
    core.close()
    assert [type(decode_from_client(message)) for message in core.outgoing()] == [Hello, Bye]


def test_chance_is_the_same_again() -> None:
    def arrivals(link: str) -> list[float]:
        core = linked(link)
        found = []
        for n in range(2000):
            now = 16 + n / 64
            core.receive(told(n), now)
            core.update(now)
            found += [now - 16 - tick / 64 for tick in heard(core)]
        return found

    assert arrivals("wifi") == arrivals("wifi")
    assert max(arrivals("lan")) == 1 / 64
    assert max(arrivals("wifi")) > 0.04, "its spikes"
    assert max(arrivals("far")) > 0.25, "what is lost is sent again"


def test_no_such_link_is_told_with_those_that_there_are() -> None:
    with pytest.raises(ValueError, match="link = 'wlan': must be one of lan, regional, typical, far, wifi"):
        Client.connect("ws://127.0.0.1:1", link="wlan")


def test_while_a_slow_line_is_busy_nothing_more_is_read() -> None:
    core = linked(PRESETS["thin"])
    assert core.appetite == SLOW_READ_BYTES
    core.receive(encode(messages.Happened(1, "told", messages.pack_value("x" * 1000))), 16.0)
    assert core.appetite == 0
    core.update(16.25)
    assert core.appetite == 0
    core.update(16.5)  # 1,100 bytes at 30 kb/s take 0.3 s
    assert core.appetite == SLOW_READ_BYTES


@pytest.mark.parametrize("link", ["wifi", *long("typical", "outage")])
def test_a_match_over_it_is_as_one_over_a_real_path(link: str) -> None:
    match = Match(load_scene("hills"), 3)
    core = LinkedCore()
    core.link = link
    match.join(wander, Path(), core)
    match.run(60)
    assert core.state == "playing"
    assert core.clock.rtt_s >= 2 * PRESETS[link].delay_s
    assert core.stats.divergences == 0
    assert set(core.stats.corrections_by_cause) <= {"late input"}


def test_an_empty_message_is_malformed_as_without_a_link() -> None:
    core = linked(FAR)
    core.receive(b"", 16.0)
    core.update(17.0)
    (left,) = core.events()
    assert isinstance(left, Left)
    assert left.code == messages.MALFORMED


@pytest.mark.e2e
def test_over_real_sockets() -> None:
    def until(client: Client, so: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 20
        while not so():
            assert time.monotonic() < deadline
            client.poll()
            client.update()
            time.sleep(0.005)

    async def scene() -> None:
        async with await AsyncClient.connect(url, link=Path(0.06)) as client:
            async for event in client:
                if isinstance(event, Joined):
                    break
            assert client.core.clock.rtt_s >= 0.12
            client.link = None
            assert client.link is None

    with real_server("--scene", "flat") as url:
        with Client.connect(url, link=Path(0.06)) as client:
            until(client, lambda: client.playing)
            assert client.core.clock.rtt_s >= 0.12
            client.link = "thin"
            goal = client.stats.snapshots + 10
            until(client, lambda: client.stats.snapshots > goal)
            client.link = None
        asyncio.run(asyncio.wait_for(scene(), 20))
