"""Tokens: which are accepted, and the reason that a refused client gets."""

import base64
import json
from pathlib import Path
from typing import Any

import jwt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.auth import tokens
from server.auth.identity import SUBJECT_MAX, AuthError
from server.auth.tokens import LEEWAY_S, Tokens, issue, read_key
from server.config.options import SettingsError

KEY, OTHER = b"k" * 32, b"o" * 32
NOW = 1_800_000_000.0


def check(token: str) -> str:
    return Tokens(KEY, lambda: NOW)(token)


def signed(claims: Any, key: bytes | None = KEY, algorithm: str = "HS256") -> str:
    return jwt.PyJWS().encode(json.dumps(claims).encode(), key, algorithm)  # type: ignore[arg-type]


def test_an_issued_token_names_its_subject_until_it_expires() -> None:
    token = issue(KEY, "ann", 3600, NOW)
    assert check(token) == "ann"
    for later, good in ((3599, True), (3600 + LEEWAY_S - 1, True), (3600 + LEEWAY_S + 1, False)):
        tokens_then = Tokens(KEY, lambda at=NOW + later: at)  # type: ignore[misc]
        if good:
            assert tokens_then(token) == "ann"
        else:
            with pytest.raises(AuthError, match="the token expired 6 s ago"):
                tokens_then(token)


GOOD = {"sub": "ann", "exp": NOW + 60}


@pytest.mark.parametrize(
    ("token", "reason"),
    [
        ("", "this server requires a token"),
        ("x", "the token is not a JWT"),
        ("a.b.c", "the token is not a JWT"),
        ("é.é.é", "the token is not a JWT"),
        (signed(GOOD, OTHER), "the token is signed with another key"),
        (signed(GOOD)[:-3] + "AAA", "the token is signed with another key"),
        (signed(GOOD, KEY * 2, "HS512"), "the token is not signed by HS256"),
        (signed(GOOD, None, "none"), "the token is not signed by HS256"),
        (signed(GOOD | {"exp": NOW - 90}), "the token expired 90 s ago"),
        (signed(GOOD | {"nbf": NOW + 90}), "the token is not valid for another 90 s"),
        (signed({"sub": "ann"}), "the token has no expiry time"),
        (signed(GOOD | {"exp": None}), "the token has no expiry time"),
        (signed(GOOD | {"exp": "soon"}), "the token's exp is not a time"),
        (signed(GOOD | {"exp": True}), "the token's exp is not a time"),
        (signed(GOOD | {"exp": float("nan")}), "the token's exp is not a time"),
        (signed(GOOD | {"exp": float("inf")}), "the token's exp is not a time"),
        (signed(GOOD | {"exp": 10**400}), "the token's exp is not a time"),
        (signed(GOOD | {"nbf": "soon"}), "the token's nbf is not a time"),
        (signed({"exp": NOW + 60}), "the token names no subject"),
        (signed(GOOD | {"sub": " "}), "the token names no subject"),
        (signed(GOOD | {"sub": 7}), "the token names no subject"),
        (signed(GOOD | {"sub": "x" * (SUBJECT_MAX + 1)}), "the token's subject is longer than 64 characters"),
        (signed([GOOD]), "the token is not a JWT"),
        (signed("ann"), "the token is not a JWT"),
    ],
)
def test_a_refused_client_gets_the_reason(token: str, reason: str) -> None:
    with pytest.raises(AuthError) as error:
        check(token)
    assert str(error.value) == reason
    assert error.value.__cause__ is None
    assert len(token) < 8 or token not in repr(error.value)


def test_a_deeply_nested_token_is_refused() -> None:
    deep = base64.urlsafe_b64encode(b'{"alg":' + b"[" * 5000).rstrip(b"=").decode()
    for token in (f"{deep}.e30.AAAA", jwt.PyJWS().encode(b"[" * 100_000, KEY, "HS256")):
        with pytest.raises(AuthError, match="the token is not a JWT"):
            check(token)


@given(st.text(max_size=200) | st.from_regex(r"eyJ[A-Za-z0-9_-]{0,40}\.[A-Za-z0-9_-]{0,40}\.[A-Za-z0-9_-]{0,40}"))
def test_any_text_is_refused_in_words(text: str) -> None:
    with pytest.raises(AuthError):
        check(text)


def test_keys_come_from_a_file_or_the_environment_and_are_long_enough(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_bytes(KEY + b"\n")
    assert read_key(str(path), {}) == read_key(None, {"SOVEREIGN_AUTH_KEY": KEY.decode()}) == KEY
    path.write_bytes(KEY[:-1] + b"\n")
    for file, environment in ((str(path), {}), (None, {"SOVEREIGN_AUTH_KEY": "short"})):
        with pytest.raises(SettingsError, match="needs at least 32") as error:
            read_key(file, environment)
        assert "short" not in str(error.value)
    with pytest.raises(SettingsError, match="cannot be read"):
        read_key(str(tmp_path), {})
    with pytest.raises(SettingsError, match="nor SOVEREIGN_AUTH_KEY"):
        read_key(None, {})


def test_the_command_prints_a_token_that_is_good_now(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "key"
    path.write_bytes(KEY)
    assert tokens.main(["--subject", "ann", "--hours", "0.5", "--auth-key-file", str(path)], {}) == 0
    assert Tokens(KEY)(capsys.readouterr().out.strip()) == "ann"
    for wrong in (["--subject", ""], ["--subject", "x" * 65], ["--subject", "ann", "--hours", "nan"]):
        with pytest.raises(SettingsError):
            tokens.main([*wrong, "--auth-key-file", str(path)], {})
