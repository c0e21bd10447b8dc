"""A core on a simulated link, by a simulated clock, and once on a real socket."""

import asyncio
import math
import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.base import set_link
from client_sdk.client import Client
from client_sdk.core import Core
from client_sdk.events import Happened, Joined, Left
from client_sdk.netsim.linked import SLOW_READ_BYTES, LinkedPort
from client_sdk.netsim.links import PRESETS, Link
from client_sdk.port import READ_BYTES
from shared import messages, payloads
from shared.messages import Bye, Hello, Inputs, Ping, decode_from_client, encode
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, wander
from tests.client_sdk.servers import ROOT, real_server
from tests.lengths import long
from tests.patience import PATIENCE_S

FAR = Link(0.125)
SOON = 2**-20
"""Time in seconds, exact in binary like the other times here."""


def linked(link: str | Link | None, now: float = 16.0) -> LinkedPort:
    port = LinkedPort(Core("Ann"))
    port.link = link
    port.open(now)
    return port


def event(number: int) -> bytes:
    return encode(messages.Happened(number, "told", payloads.pack_value(None)))


def received(port: LinkedPort) -> list[int]:
    return [event.tick for event in port.core.events() if isinstance(event, Happened)]


def test_without_a_link_nothing_waits() -> None:
    port = linked(None)
    assert len(port.outgoing()) == 1
    port.receive(event(1), 16.0)
    assert received(port) == [1]
    assert port.appetite == READ_BYTES


def test_each_way_takes_as_long_as_the_path() -> None:
    port = linked(FAR)
    port.receive(event(1), 16.0)
    assert port.outgoing() == []
    assert port.next_update(16.0) == 16.125
    port.update(16.125 - SOON)
    assert port.outgoing() == []
    assert received(port) == []
    port.update(16.125)
    assert [type(decode_from_client(message)) for message in port.outgoing()] == [Hello]
    assert received(port) == [1]
    assert port.next_update(16.125) == math.inf


def test_a_message_takes_its_time_from_when_it_comes() -> None:
    port = linked(FAR)
    port.update(16.0)
    port.receive(event(1), 17.0)
    port.update(17.125 - SOON)
    assert received(port) == []
    port.update(17.125)
    assert received(port) == [1]


def test_messages_on_the_way_stay_in_front_when_the_link_changes() -> None:
    port = linked(FAR)
    port.receive(event(1), 16.0)
    port.link = Link(0.0625)
    port.receive(event(2), 16.0)
    port.link = None
    port.receive(event(3), 16.0)
    port.update(16.125 - SOON)
    assert received(port) == []
    port.update(16.125)
    assert received(port) == [1, 2, 3]
    assert len(port.outgoing()) == 1
    port.update(16.25)
    port.receive(event(4), 16.25)
    assert received(port) == [4]
    port.link = "far"
    port.receive(event(5), 16.25)
    port.update(16.3)
    assert received(port) == []
    port.update(17.0)
    assert received(port) == [5]


def test_the_end_is_reported_after_the_messages_before_it() -> None:
    port = linked(FAR)
    port.receive(encode(Bye(messages.FULL, "the server is full", -1.0)), 16.0)
    port.lost(1006, "gone", 16.0)
    port.update(16.125 - SOON)
    assert port.core.state == "joining"
    port.update(16.125)
    assert port.core.events() == [Left(messages.FULL, "the server is full")]


def test_messages_on_a_lost_line_are_gone() -> None:
    match = Match(load_scene("flat"), 1)
    core = Core(patience_s=10)
    player = match.join(wander, Link(), core)
    match.run_until(lambda: core.state == "playing", 10)
    set_link(core, FAR)
    match.run(1)
    match.game.lost(player.session, match.now)
    now = player.local
    core.port.lost(1006, "gone", now)
    assert core.state == "playing", "the client does not know of the loss yet"
    core.port.update(now + 1)
    assert core.state == "reconnecting"
    core.port.open(now + 1)
    assert core.port.outgoing() == []
    core.port.update(now + 1.125 - SOON)
    assert core.port.outgoing() == []
    core.port.update(now + 1.125 + SOON)
    kinds = [type(decode_from_client(message)) for message in core.port.outgoing()]
    assert kinds[0] is Hello
    assert Inputs not in kinds
    assert set(kinds) <= {Hello, Ping}


def test_the_goodbye_does_not_wait() -> None:
    port = linked(FAR)
    port.core.close()
    assert [type(decode_from_client(message)) for message in port.outgoing()] == [Hello, Bye]


def test_chance_is_the_same_again() -> None:
    def arrivals(link: str) -> list[float]:
        port = linked(link)
        found = []
        for n in range(2000):
            now = 16 + n / 64
            port.receive(event(n), now)
            port.update(now)
            found += [now - 16 - tick / 64 for tick in received(port)]
        return found

    assert arrivals("wifi") == arrivals("wifi")
    assert max(arrivals("lan")) == 1 / 64
    assert max(arrivals("wifi")) > 0.04, "spikes"
    assert max(arrivals("far")) > 0.25, "lost packets are sent again"


def test_an_unknown_link_is_refused_with_a_list_of_the_known_ones() -> None:
    with pytest.raises(ValueError, match="link = 'wlan': must be one of lan, regional, typical, far, wifi"):
        Client.connect("ws://127.0.0.1:1", link="wlan")


def test_while_a_slow_line_is_busy_nothing_more_is_read() -> None:
    port = linked(PRESETS["thin"])
    assert port.appetite == SLOW_READ_BYTES
    port.receive(encode(messages.Happened(1, "told", payloads.pack_value("x" * 1000))), 16.0)
    assert port.appetite == 0
    port.update(16.25)
    assert port.appetite == 0
    port.update(16.5)  # 1,100 bytes at 30 kb/s take 0.3 s
    assert port.appetite == SLOW_READ_BYTES


@pytest.mark.parametrize("link", ["wifi", *long("typical", "outage")])
def test_a_match_over_it_is_as_one_over_a_real_path(link: str) -> None:
    match = Match(load_scene("hills"), 3)
    core = Core()
    set_link(core, link)
    match.join(wander, Link(), core)
    match.run(60)
    assert core.state == "playing"
    assert core.clock.rtt_s >= 2 * PRESETS[link].delay_s
    assert core.stats.divergences == 0
    assert set(core.stats.corrections_by_cause) <= {"late input"}


def test_an_empty_message_is_malformed_as_without_a_link() -> None:
    port = linked(FAR)
    port.receive(b"", 16.0)
    port.update(17.0)
    (left,) = port.core.events()
    assert isinstance(left, Left)
    assert left.code == messages.MALFORMED


@pytest.mark.e2e
def test_over_real_sockets() -> None:
    def until(client: Client, so: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not so():
            assert time.monotonic() < deadline
            client.poll()
            client.update()
            time.sleep(0.005)

    async def scene() -> None:
        async with await AsyncClient.connect(url, link=Link(0.06)) as client:
            async for event in client:
                if isinstance(event, Joined):
                    break
            assert client.core.clock.rtt_s >= 0.12
            client.link = None
            assert client.link is None

    with real_server("--scene", "flat") as url:
        with Client.connect(url, link=Link(0.06)) as client:
            until(client, lambda: client.playing)
            assert client.core.clock.rtt_s >= 0.12
            client.link = "thin"
            goal = client.stats.snapshots + 10
            until(client, lambda: client.stats.snapshots > goal)
            client.link = None
        asyncio.run(asyncio.wait_for(scene(), PATIENCE_S))


def test_a_client_without_a_link_has_nothing_of_the_simulator() -> None:
    program = "import sys\nfrom client_sdk import Client, Loopback\nfrom server import Game\n"
    program += "from shared.scene import load_scene\nLoopback(Game(load_scene('flat'))).join().poll(0.0)\n"
    program += "print([name for name in sys.modules if 'netsim' in name])"
    done = subprocess.run((sys.executable, "-c", program), cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
