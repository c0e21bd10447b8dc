"""TLS from end to end (wss://): a certificate made for the test, a server process, both transports of the SDK."""

import asyncio
import ssl
from collections.abc import Iterator
from pathlib import Path

import pytest
import trustme

from client_sdk import Joined, list_worlds
from client_sdk.async_client import AsyncClient
from client_sdk.client import Client
from client_sdk.transports.common import ConnectError
from tests.e2e.processes import END_S, ServerProcess, running
from tests.patience import until

pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def authority() -> trustme.CA:
    return trustme.CA()


@pytest.fixture(scope="module")
def trust(authority: trustme.CA) -> ssl.SSLContext:
    context = ssl.create_default_context()
    authority.configure_trust(context)
    return context


@pytest.fixture(scope="module")
def server(authority: trustme.CA, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    folder: Path = tmp_path_factory.mktemp("tls")
    issued = authority.issue_cert("localhost", "127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(folder / "cert.pem")
    issued.private_key_pem.write_to_path(folder / "key.pem")
    settings = folder / "worlds.toml"
    settings.write_text('[worlds.arena]\nscene = "flat"\n', "utf-8")
    files = ("--tls-cert", str(folder / "cert.pem"), "--tls-key", str(folder / "key.pem"), "--config", str(settings))
    with running("--port", "0", "--scene", "flat", *files) as process:
        yield process
        process.process.terminate()
        assert process.end() == 0
        assert process.log(but="info") == []


@pytest.fixture(scope="module")
def url(server: ServerProcess) -> str:
    return "wss://{}:{}".format(*server.address())


def plays(client: Client) -> bool:
    client.poll()
    client.set_input(1, 0)
    client.update()
    return client.playing and client.stats.snapshots > 10


def test_polling(url: str, trust: ssl.SSLContext) -> None:
    with Client.connect(url, name="Ann", tls=trust) as client:
        until(lambda: plays(client))
        assert client.stats.divergences == 0


async def test_aio(url: str, trust: ssl.SSLContext) -> None:
    async with asyncio.timeout(END_S), await AsyncClient.connect(url, name="Bob", tls=trust) as client:
        while client.core.state != "playing" or client.stats.snapshots <= 10:  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.01)
        assert client.stats.divergences == 0


async def test_a_match(url: str, trust: ssl.SSLContext) -> None:
    by_name = url.replace("127.0.0.1", "localhost")
    with Client.match(by_name, "arena", tls=trust) as client:
        until(lambda: plays(client))
        async with asyncio.timeout(END_S), await AsyncClient.match(by_name, "arena", tls=trust) as other:
            async for event in other:
                if isinstance(event, Joined):
                    break
            assert client.world == other.world == "arena-1"
        (entry,) = list_worlds(url, tls=trust)
        assert entry.name == "arena-1"
    with pytest.raises(ConnectError, match="no list of worlds"):
        list_worlds(url)


async def test_a_client_that_does_not_trust_the_certificate_gets_the_reason(url: str) -> None:
    with pytest.raises(ConnectError, match="no secure connection"):
        Client.connect(url)
    with pytest.raises(ConnectError, match="no secure connection"):
        await AsyncClient.connect(url)


def test_without_tls_there_is_no_connection(url: str) -> None:
    with pytest.raises(ConnectError):
        Client.connect(url.replace("wss://", "ws://"))


def test_check_asks_by_any_name(url: str) -> None:
    with running("check", "--url", url.replace("wss://", "https://") + "/readyz") as check:
        assert check.end() == 0
