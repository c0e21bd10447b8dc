"""What `check` asks; that it does is in tests/e2e/test_server_process.py."""

import pytest

from server import check
from server.kinds import SettingsError


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
    assert check.page(url) == page


@pytest.mark.parametrize("url", ["", "127.0.0.1:8765", "ftp://x", "http://", "http:///readyz", "ws:/x"])
def test_what_is_no_address(url: str) -> None:
    with pytest.raises(SettingsError) as error:
        check.main(["--url", url], {})
    assert str(error.value) == f"url = {url!r}: must be like ws://HOST:PORT, wss://, http:// or https://"
