"""The address that the health check asks. tests/e2e/test_server_process.py runs the check itself."""

import pytest

from server.config.options import SettingsError
from server.runtime import healthcheck


@pytest.mark.parametrize(
    ("url", "page"),
    [
        ("ws://127.0.0.1:8765", "http://127.0.0.1:8765/readyz"),
        ("wss://play.example/", "https://play.example/readyz"),
        ("http://[::1]:8765", "http://[::1]:8765/readyz"),
        ("https://play.example/game/readyz", "https://play.example/game/readyz"),
        ("http://127.0.0.1:1/healthz", "http://127.0.0.1:1/healthz"),
    ],
)
def test_it_asks_whether_the_server_is_ready_where_no_page_is_named(url: str, page: str) -> None:
    assert healthcheck.page(url) == page


@pytest.mark.parametrize("url", ["", "127.0.0.1:8765", "ftp://x", "http://", "http:///readyz", "ws:/x"])
def test_an_invalid_address_is_refused(url: str) -> None:
    with pytest.raises(SettingsError) as error:
        healthcheck.main(["--url", url], {})
    assert str(error.value) == f"url = {url!r}: must be like ws://HOST:PORT, wss://, http:// or https://"


@pytest.mark.parametrize(
    ("host", "asked"),
    [
        (None, "127.0.0.1"),
        ("0.0.0.0", "127.0.0.1"),
        ("::", "127.0.0.1"),
        ("[::]", "127.0.0.1"),
        ("::1", "[::1]"),
        ("10.1.2.3", "10.1.2.3"),
        ("play.example", "play.example"),
    ],
)
def test_it_asks_where_the_server_of_the_same_environment_listens(
    host: str | None, asked: str, capsys: pytest.CaptureFixture[str]
) -> None:
    environment = {"SOVEREIGN_PORT": "9000", **({} if host is None else {"SOVEREIGN_HOST": host})}
    with pytest.raises(SystemExit):
        healthcheck.main(["--help"], environment)
    assert f"(default: http://{asked}:9000/readyz)" in " ".join(capsys.readouterr().out.split())
