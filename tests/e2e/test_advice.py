"""The error that a newcomer reads for each mistake, made for real with both kinds of client."""

import asyncio
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import trustme

from client_sdk import AsyncClient, Client, ConnectError, Event, Joined, Left, Loopback
from server.auth.identity import AuthError
from server.auth.tokens import Tokens
from server.config.limits import Limits
from server.game import Game
from shared import messages
from shared.scene import load_scene
from tests.client_sdk.servers import request, scripted_server
from tests.e2e.processes import END_S, running
from tests.server.test_tokens import GOOD, KEY, NOW, OTHER, signed

pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def plain() -> Iterator[str]:
    with running("--port", "0", "--scene", "flat") as process:
        yield "{}:{}".format(*process.address())


@pytest.fixture(scope="module")
def secure(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder: Path = tmp_path_factory.mktemp("tls")
    issued = trustme.CA().issue_cert("localhost", "127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(folder / "cert.pem")
    issued.private_key_pem.write_to_path(folder / "key.pem")
    files = ("--tls-cert", str(folder / "cert.pem"), "--tls-key", str(folder / "key.pem"))
    with running("--port", "0", "--scene", "flat", *files) as process:
        yield "{}:{}".format(*process.address())


async def error_of(url: str) -> str:
    """Returns the error of both clients for an address, which is the same."""
    with pytest.raises(ConnectError) as polling:
        await asyncio.to_thread(Client.connect, url, timeout=END_S)
    with pytest.raises(ConnectError) as aio:
        await AsyncClient.connect(url, timeout=END_S)
    assert str(polling.value) == str(aio.value)
    assert url in str(aio.value)
    return str(aio.value).replace(url, "URL")


async def test_no_server_is_there() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    wanted = f"URL: no server there (connection refused); start one with: sovereign-server --port {port}"
    assert await error_of(f"ws://127.0.0.1:{port}") == wanted


@pytest.mark.parametrize("url", ["example.org:8765", "http://example.org:8765"])
async def test_an_invalid_address(url: str) -> None:
    assert await error_of(url) == "'URL': scheme isn't ws or wss; a server's address looks like ws://localhost:8765"


async def test_a_host_that_does_not_exist() -> None:
    found = await error_of("ws://nobody.invalid:8765")
    assert found.startswith("URL: cannot be reached (")
    assert found.endswith("); is the address right?")


def test_another_kind_of_server_is_there() -> None:
    def page(sock: socket.socket) -> None:
        request(sock)
        sock.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")

    with scripted_server(page) as url, pytest.raises(ConnectError) as error:
        Client.connect(url)
    why = (
        "something is there, but it is not a Sovereign Netcode server (HTTP status 404); are host, port and path right?"
    )
    assert str(error.value) == f"{url}: {why}"


def test_the_server_is_about_to_start_again() -> None:
    def page(sock: socket.socket) -> None:
        request(sock)
        sock.sendall(
            b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nRetry-After: 3\r\nContent-Length: 24\r\n"
            b"\r\nthe server is going down"
        )

    with scripted_server(page) as url, pytest.raises(ConnectError) as error:
        Client.connect(url)
    assert str(error.value) == f"{url}: the server is going down; try again in 3 s"
    assert error.value.wait_s == 3


async def test_tls_on_one_side_only(plain: str, secure: str) -> None:
    found = await error_of(f"wss://{plain}")
    assert found == f"URL: no secure connection, the server does not speak TLS; try ws://{plain}"
    assert (await error_of(f"ws://{secure}")).endswith("; if the server speaks TLS, use wss://")


async def test_a_certificate_that_is_not_trusted(secure: str) -> None:
    found = await error_of(f"wss://{secure}")
    assert found.startswith("URL: no secure connection, the server's certificate is not trusted (")
    assert found.endswith(
        '); if it is one of your own: connect(url, tls=ssl.create_default_context(cafile="cert.pem"))'
    )


# -- refused by the game: the wire format is the same, so no socket is needed --------------------------------


def left(game: Game, token: str = "", change: Callable[[Client], None] | None = None) -> Left:
    client = Loopback(game).join("Ann", token=token)
    if change is not None:
        change(client)
    events: list[Event] = []
    for frame in range(120):
        events += client.poll(frame / 60)
        client.update(frame / 60)
    assert not any(isinstance(event, Joined) for event in events)
    (found,) = [event for event in events if isinstance(event, Left)]
    return found


@pytest.mark.parametrize(
    ("token", "wanted"),
    [
        ("", "this server requires a token"),
        ("rubbish", "the token is not a JWT"),
        (signed(GOOD | {"exp": NOW - 90}), "the token expired 90 s ago"),
        (signed(GOOD, OTHER), "the token is signed with another key"),
    ],
)
def test_a_token_that_is_refused(token: str, wanted: str) -> None:
    found = left(Game(load_scene("flat"), authenticate=Tokens(KEY, lambda: NOW)), token)
    assert found.code == messages.UNAUTHORISED
    assert found.reason == f"{wanted}; connect with token=... and a valid token; the operator of the server issues them"


def test_the_reason_of_a_games_own_check() -> None:
    def check(token: str) -> str:
        raise AuthError("the club is closed on Mondays")

    assert left(Game(load_scene("flat"), authenticate=check)).reason.startswith("the club is closed on Mondays; ")


def test_the_server_is_full() -> None:
    found = left(Game(load_scene("flat"), limits=Limits(clients_max=0)))
    assert (found.code, found.reason) == (messages.FULL, "the server is full (0 clients)")


def test_another_scene() -> None:
    def change(client: Client) -> None:
        client.core.scene = load_scene("arena")

    found = left(Game(load_scene("flat")), change=change)
    assert found.code == messages.WRONG_SCENE
    assert found.reason.startswith("the server plays another scene (")
    assert found.reason.endswith(
        " differ); connect with the scene that the server plays, or without scene= to take its own"
    )


def test_another_version(monkeypatch: pytest.MonkeyPatch) -> None:
    game = Game(load_scene("flat"))
    receive = game.receive

    def older(session: object, data: bytes, now: float) -> None:
        message = messages.decode_from_client(data)
        if isinstance(message, messages.Hello):
            data = messages.encode(message._replace(version=messages.VERSION - 1))
        receive(session, data, now)  # type: ignore[arg-type]

    monkeypatch.setattr(game, "receive", older)
    found = left(game)
    assert found.code == messages.WRONG_VERSION
    assert found.reason == (
        f"the client is older: protocol version {messages.VERSION - 1}, the server speaks {messages.VERSION}; "
        "use the client_sdk that comes with the server"
    )
