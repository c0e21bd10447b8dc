"""The real process: its output, its end, and that garbage from a peer leaves no trace in its log."""

import asyncio
import os
import random
import re
import signal
import socket
import sys
import time
import urllib.error
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from client_sdk.client import Client
from client_sdk.transports.common import ConnectError
from server.auth.tokens import issue
from shared.messages import UNAUTHORISED, VERSION, Bye, Hello, Inputs, Message, Welcome, decode_from_server, encode
from tests.e2e.processes import (
    END_S,
    MOVING_BLOCKS,
    RECOVERY_S,
    START_S,
    UPGRADE,
    ServerProcess,
    Strider,
    inheriting,
    other,
    page,
    running,
    stats,
)
from tests.lengths import long
from tests.patience import until

pytestmark = pytest.mark.e2e

SUSPENDED_S = 3.0


@contextmanager
def joined(address: tuple[str, int]) -> Iterator[tuple[ClientConnection, Welcome]]:
    with connect(f"ws://{address[0]}:{address[1]}", compression=None, max_queue=None) as link:
        link.send(encode(Hello(VERSION, {}, "test")))
        welcome = decode_from_server(link.recv(END_S, decode=False))
        assert isinstance(welcome, Welcome), welcome
        yield link, welcome


def last_words(link: ClientConnection) -> Message:
    """Returns the last message before the server closes, which it must do with a code."""
    last = None
    try:
        while True:
            last = decode_from_server(link.recv(END_S, decode=False))
    except ConnectionClosed:
        assert link.close_code != 1006, "without a close frame"
    assert last is not None
    return last


def test_it_serves_and_sends_a_bye_at_its_end() -> None:
    with running("--play", "false", "--port", "0", "--scene", "flat", "--tick-rate", "64") as server:
        address = server.address()
        assert page(address, "/healthz") == "ok\n"
        until(lambda: status(address, "/readyz") == (200, "ready\n"))
        with joined(address) as (link, welcome):
            link.send(encode(Inputs(welcome.tick + 3, welcome.tick, bytes((127, 0, 0)) * 3)))
            until(lambda: stats(address)["tick"] > welcome.tick + 20)
            figures = stats(address)
            assert (figures["clients"], figures["tick_rate"], figures["internal_errors"]) == (1, 64, 0)
            assert figures["ticks"] >= 20
            assert figures["rss_mb"] > 10
            assert figures["cpu_s"] > 0
            assert "sovereign_clients 1.0\n" in page(address, "/metrics")
            assert set(figures["tick_lateness_ms"]) == set(figures["tick_work_ms"]) == {"p50", "p99", "max"}
            asked = time.monotonic()
            server.process.send_signal(signal.SIGTERM)
            bye = last_words(link)
        assert isinstance(bye, Bye)
        assert bye.wait > 0
        assert server.end() == 0
        assert time.monotonic() - asked < 4
        assert server.rest() == [f"live page at http://127.0.0.1:{address[1]}/\n"]
        assert [(entry["level"], entry["event"]) for entry in server.log()] == [
            ("info", "started"), ("info", "stopping"), ("info", "stopped"),
        ]  # fmt: skip


@contextmanager
def mute(address: tuple[str, int]) -> Iterator[socket.socket]:
    """A WebSocket client that sends nothing more, not even when the server closes."""
    with socket.create_connection(address) as link:
        link.sendall(UPGRADE)
        assert link.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 101"
        yield link


@pytest.mark.parametrize("number", [signal.SIGTERM, *long(signal.SIGINT)])
@pytest.mark.slow
def test_a_client_that_does_not_answer_does_not_delay_the_end(number: signal.Signals) -> None:
    with running("--port", "0", "--scene", "flat") as server:
        address = server.address()
        with mute(address), socket.create_connection(address):
            until(lambda: stats(address)["connections"] >= 2)
            asked = time.monotonic()
            assert server.end(number) == 0
            assert time.monotonic() - asked < 4


def test_players_show_tokens_which_are_in_no_log(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_text("k" * 32)
    code, lines = other("token", "--subject", "ann", "--hours", "1", "--auth-key-file", str(key))
    assert code == 0
    good = lines[0].strip()
    forged = issue(b"o" * 32, "ann", 3600, time.time())
    with running(
        "--port", "0", "--scene", "flat", "--auth", "token", "--auth-key-file", str(key), "--log-level", "debug"
    ) as server:
        address = server.address()
        assert says(address, Hello(VERSION, {}, "ann", good)) is Welcome
        for token, reason in (("", "requires a token"), (forged, "another key"), (good[:-4] + "AAAA", "another key")):
            bye = says(address, Hello(VERSION, {}, "eve", token))
            assert isinstance(bye, Bye)
            assert bye.code == UNAUTHORISED
            assert reason in bye.reason
        assert page(address, f"/healthz?token={good}") == "ok\n"
        assert server.end(signal.SIGTERM) == 0
        text = "".join(server.errors)
        assert not [part for token in (good, forged) for part in token.split(".")[1:] if part in text]
        assert server.log(), "there are log entries to check"


def says(address: tuple[str, int], hello: Hello) -> type[Welcome] | Message:
    """Sends a hello. Returns the answer, or `Welcome` if it is one."""
    with connect(f"ws://{address[0]}:{address[1]}", compression=None, max_queue=None) as link:
        link.send(encode(hello))
        answer = decode_from_server(link.recv(END_S, decode=False))
        return Welcome if isinstance(answer, Welcome) else answer


def status(address: tuple[str, int], path: str) -> tuple[int, str]:
    try:
        return 200, page(address, path)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_while_draining_it_accepts_no_clients_and_is_not_ready() -> None:
    with running("--port", "0", "--scene", "flat", "--restart-s", "7") as server:
        address = server.address()
        with mute(address):  # the server waits for the answer to its close frame
            until(lambda: status(address, "/readyz") == (200, "ready\n"))
            server.process.send_signal(signal.SIGTERM)
            until(lambda: status(address, "/readyz") == (503, "not ready: draining\n"))
            with pytest.raises(InvalidStatus) as refused:
                connect(f"ws://{address[0]}:{address[1]}")
            assert refused.value.response.status_code == 503
            assert refused.value.response.headers["Retry-After"] == "7"
            assert server.end() == 0


def test_a_connection_beyond_a_limit_is_refused_before_the_websocket_opens() -> None:
    with running(
        "--port", "0", "--scene", "flat", "--loopback-exempt", "no", "--connections-per-address", "1"
    ) as server:
        address = server.address()
        url = "ws://{}:{}".format(*address)
        with Client.connect(url, name="Ann") as client:
            with pytest.raises(
                ConnectError, match=r"too many connections from your address \(1 are allowed\)"
            ) as error:
                Client.connect(url, name="Bob")
            assert error.value.wait_s == 2.0
            until(lambda: stats(address)["refused_at_door"] == {"address": 1})
            client.poll()
            assert not client.closed
        assert server.end(signal.SIGTERM) == 0


@pytest.mark.skipif(os.name == "nt", reason="there is no such signal")
@pytest.mark.parametrize("rate", [32, *long(128)])
def test_a_suspended_server_goes_on_and_so_do_its_clients(rate: int) -> None:
    """After 3 s without CPU time, the server catches up on some ticks and drops the others. Clients do not reconnect,
    and within two seconds the players move again."""
    with running("--port", "0", "--scene", "flat", "--tick-rate", str(rate)) as server:
        address = server.address()
        with Client.connect("ws://{}:{}".format(*address), name="Ann") as client:
            player = Strider(client)
            player.plays(seconds=2.0)
            assert player.plays(seconds=2.0) > MOVING_BLOCKS
            before = stats(address)
            server.process.send_signal(signal.SIGSTOP)
            player.plays(seconds=SUSPENDED_S)
            server.process.send_signal(signal.SIGCONT)
            player.plays(seconds=RECOVERY_S)
            used, tick = client.stats.inputs_used, stats(address)["tick"]
            assert player.plays(seconds=2.0) > MOVING_BLOCKS
            after = stats(address)
            assert client.stats.inputs_used - used > 0.5 * (after["tick"] - tick)
            assert client.playing
            assert client.stats.divergences == 0
            assert after["skipped_s"] - before["skipped_s"] >= SUSPENDED_S - 1
            assert (after["clients"], after["kicked"], after["internal_errors"]) == (1, 0, 0)
        assert server.end(signal.SIGTERM) == 0
        assert "the process was suspended, or got no CPU" in [entry["event"] for entry in server.log(busy=True)]


@pytest.mark.skipif(os.name == "nt", reason="a signal ends a process there")
def test_a_second_signal_ends_it_at_once() -> None:
    with running("--port", "0", "--scene", "flat") as server, mute(server.address()):
        server.process.send_signal(signal.SIGINT)
        until(lambda: any("stopping" in line for line in server.errors))
        asked = time.monotonic()
        assert server.end(signal.SIGINT) == -signal.SIGINT
        assert time.monotonic() - asked < 1


@pytest.mark.skipif(os.name == "nt", reason="a signal ends a process there")
@pytest.mark.parametrize("number", [signal.SIGINT, *long(signal.SIGTERM)])
def test_a_signal_that_was_inherited_as_ignored_ends_it(number: signal.Signals) -> None:
    """A shell makes the background jobs of a script ignore SIGINT."""
    with inheriting(signal.SIG_IGN, number), running("--port", "0", "--scene", "flat") as server:
        server.address()
        assert server.end(number) == 0
        assert server.log()[-1]["event"] == "stopped"


@pytest.mark.skipif(os.name == "nt", reason="there is no such signal")
@pytest.mark.slow
def test_a_terminal_that_closes_ends_it_in_order_and_nohup_keeps_it() -> None:
    with inheriting(signal.SIG_DFL, signal.SIGHUP), running("--port", "0", "--scene", "flat") as server:
        address = server.address()
        with joined(address) as (link, _):
            server.process.send_signal(signal.SIGHUP)
            assert isinstance(last_words(link), Bye)
        assert server.end() == 0
    with inheriting(signal.SIG_IGN, signal.SIGHUP), running("--port", "0", "--scene", "flat") as server:
        address = server.address()
        server.process.send_signal(signal.SIGHUP)
        tick = stats(address)["tick"]
        until(lambda: stats(address)["tick"] > tick + 5)
        assert server.end(signal.SIGTERM) == 0
        assert [entry["reason"] for entry in server.log() if entry["event"] == "stopping"] == ["SIGTERM"]


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc")
def test_a_signal_before_it_is_ready_ends_it_well() -> None:
    with running("--port", "0") as server:
        until(lambda: catches_sigterm(server), START_S)
        assert server.end(signal.SIGTERM) == 0


def catches_sigterm(server: ServerProcess) -> bool:
    status = Path(f"/proc/{server.process.pid}/status").read_text()
    found = re.search(r"^SigCgt:\s*([0-9a-f]+)", status, re.MULTILINE)
    return found is not None and bool(int(found[1], 16) >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize("host", ["localhost", *long("::1")])
def test_other_hosts(host: str) -> None:
    if host == "::1":
        try:
            with socket.socket(socket.AF_INET6) as probe:
                probe.bind(("::1", 0))
        except OSError:
            pytest.skip("no IPv6")
    with running("--port", "0", "--scene", "flat", "--host", host) as server:
        address = server.address()
        with socket.create_connection(address):
            pass
        assert server.end(signal.SIGTERM) == 0


async def storm(address: tuple[str, int]) -> None:
    """Sends garbage of every kind, in every state of a connection."""
    rng = random.Random(11)

    async def one(turn: int) -> None:
        reader, writer = await asyncio.open_connection(*address)
        body = rng.randbytes(rng.choice((1, 5, 100, 9000)))
        if turn % 3 == 1:
            body = UPGRADE + body
        elif turn % 3 == 2:  # well-formed frames with random content
            body = UPGRADE + b"\x82\xfe" + len(body[:200]).to_bytes(2, "big") + b"\0\0\0\0" + body[:200]
        writer.write(body)
        try:
            if turn % 2:
                writer.write_eof()
                await asyncio.wait_for(reader.read(), END_S)
        except ConnectionError:
            pass
        finally:
            writer.transport.abort()

    await asyncio.gather(*(one(turn) for turn in range(200)))


def test_garbage_leaves_no_trace_and_the_ticks_go_on() -> None:
    with running("--port", "0", "--scene", "flat") as server:
        address = server.address()
        with joined(address):
            asyncio.run(storm(address))
            until(lambda: stats(address)["connections"] == 2)  # the joined client, and the one that asks for the page
            before = stats(address)
            until(lambda: stats(address)["tick"] > before["tick"] + 5)
            assert stats(address)["internal_errors"] == 0
            assert stats(address)["clients"] == 1
        assert server.end(signal.SIGTERM) == 0
        assert server.log(but="info") == []
