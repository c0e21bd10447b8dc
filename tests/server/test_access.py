"""Settings that decide about players: anyone, tokens, or a function of the game."""

import pytest

from server.auth.access import authenticator, tls_context
from server.auth.tokens import Tokens, issue
from server.config.options import SettingsError
from server.config.settings import Settings


def check_of_ones_own(token: str) -> str:
    return token.upper()


def test_settings_choose_anyone_tokens_or_a_games_own_check(monkeypatch: pytest.MonkeyPatch) -> None:
    assert authenticator(Settings()) is None
    monkeypatch.setenv("SOVEREIGN_AUTH_KEY", "k" * 32)
    tokens = authenticator(Settings(auth="token"))
    assert isinstance(tokens, Tokens)
    assert tokens(issue(b"k" * 32, "ann", 60, 4e9)) == "ann"
    own = authenticator(Settings(auth=f"{__name__}:check_of_ones_own"))
    assert own is not None
    assert own("ann") == "ANN"


@pytest.mark.parametrize("auth", ["no.such:thing", "json:nothing", ".:x", "sys:path"])
def test_an_invalid_check_is_reported(auth: str) -> None:
    with pytest.raises(SettingsError, match="auth = "):
        authenticator(Settings(auth=auth))


def test_no_certificate_no_tls() -> None:
    assert tls_context(Settings()) is None
