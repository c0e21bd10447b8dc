"""Signed tokens (JWT, HS256) with a subject and an expiry time: checks them for the game, and issues them."""

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jwt

from server.auth.identity import SUBJECT_MAX, AuthError
from server.config.options import Parser, SettingsError
from server.config.settings import KEY_VARIABLE
from shared.checks import text, utf8

ALGORITHM = "HS256"
KEY_BYTES_MIN = 32
"""Minimum length of a key in bytes: that of an HS256 digest. A shorter key would make the signature weaker."""
LEEWAY_S = 5.0
"""Seconds by which the clocks of the issuer and of this server may differ."""
HOURS_MAX = 24 * 366
"""Maximum validity of a token that `sovereign-server token` issues, in hours."""


class Tokens:
    """An `Authenticator` that checks signed tokens.

    Args:
        key: the key with which a token must be signed.
        clock: returns seconds since 1970.
    """

    def __init__(self, key: bytes, clock: Callable[[], float] = time.time) -> None:
        self._key = key
        self._clock = clock
        self._signatures = jwt.PyJWS(algorithms=[ALGORITHM])

    def __call__(self, token: str) -> str:
        """Checks a token and returns its subject.

        Raises:
            AuthError: it is not a token, is not signed with the key, has no subject, has expired or is not valid yet.
        """
        if not token:
            raise AuthError("this server requires a token")
        claims, now = self._signed(token), self._clock()
        expiry, begin = _time(claims, "exp"), _time(claims, "nbf")
        if expiry is None:
            raise AuthError("the token has no expiry time")
        if now >= expiry + LEEWAY_S:
            raise AuthError(f"the token expired {now - expiry:.0f} s ago")
        if begin is not None and now < begin - LEEWAY_S:
            raise AuthError(f"the token is not valid for another {begin - now:.0f} s")
        subject = claims.get("sub")
        if not isinstance(subject, str) or not subject.strip():
            raise AuthError("the token names no subject")
        if len(subject) > SUBJECT_MAX:
            raise AuthError(f"the token's subject is longer than {SUBJECT_MAX} characters")
        if not utf8(subject):
            raise AuthError(f"the token's subject {subject!r} cannot be encoded in UTF-8")
        return subject

    def _signed(self, token: str) -> dict[str, Any]:
        try:
            claims = json.loads(self._signatures.decode(token, self._key, algorithms=[ALGORITHM]))
        except jwt.InvalidSignatureError:
            raise AuthError("the token is signed with another key") from None
        except jwt.InvalidAlgorithmError:
            raise AuthError(f"the token is not signed by {ALGORITHM}") from None
        except (jwt.PyJWTError, ValueError, TypeError, RecursionError):
            raise AuthError("the token is not a JWT") from None
        if not isinstance(claims, dict):
            raise AuthError("the token is not a JWT")
        return claims


def time_of_day() -> float:
    """Returns the time of day in seconds, for the expiry of tokens that several processes check."""
    return time.time()


def _time(claims: Mapping[str, Any], name: str) -> float | None:
    """Returns a claim in seconds since 1970; None if the token does not have it.

    Raises:
        AuthError: it is not a number.
    """
    value = claims.get(name)
    if value is None:
        return None
    if type(value) not in (int, float) or not -1e15 < value < 1e15 or math.isnan(value):
        raise AuthError(f"the token's {name} is not a time")
    return float(value)


def issue(key: bytes, subject: str, seconds: float, now: float) -> str:
    """Returns a signed token.

    Args:
        key: the key to sign with.
        subject: name of the player, 1 to `SUBJECT_MAX` characters.
        seconds: how long the token is valid.
        now: begin of its validity, in seconds since 1970.

    Raises:
        SceneError: the subject is empty or too long, or UTF-8 cannot encode it.
    """
    text(subject, "subject", SUBJECT_MAX)
    return jwt.encode({"sub": subject, "iat": int(now), "exp": math.ceil(now + seconds)}, key, ALGORITHM)


def read_key(path: str | None, environment: Mapping[str, str]) -> bytes:
    """Returns the key for tokens.

    Args:
        path: a file with the key, of which leading and trailing spaces are ignored; None: read `KEY_VARIABLE` instead.
        environment: the environment variables.

    Raises:
        SettingsError: there is no key, or it is too short.
    """
    if path is None:
        origin, key = KEY_VARIABLE, environment.get(KEY_VARIABLE, "").encode(errors="surrogateescape")
        if not key:
            raise SettingsError(f"tokens need a key, but neither auth_key_file nor {KEY_VARIABLE} is set")
    else:
        origin = f"auth_key_file = {path!r}"
        try:
            key = Path(path).read_bytes().strip()
        except OSError as error:
            raise SettingsError(f"{origin}: cannot be read ({error.strerror or error})") from error
    if len(key) < KEY_BYTES_MIN:
        raise SettingsError(
            f"{origin}: a key of {len(key)} bytes; it needs at least {KEY_BYTES_MIN}, as made by: openssl rand -hex 32"
        )
    return key


def main(arguments: Sequence[str], environment: Mapping[str, str] = os.environ) -> int:
    """Runs `sovereign-server token`: prints a token. Returns the exit code 0.

    Raises:
        SettingsError: the key or an argument cannot be used.
    """
    parser = Parser(
        prog="sovereign-server token", description="Issues a token with which a player can join.", allow_abbrev=False
    )
    parser.add_argument("--subject", required=True, help=f"name of the player, up to {SUBJECT_MAX} characters")
    parser.add_argument("--hours", type=float, default=24.0, help="hours for which the token is valid (default: 24)")
    parser.add_argument(
        "--auth-key-file",
        default=environment.get("SOVEREIGN_AUTH_KEY_FILE"),
        help=f"file with the key; alternatively the key itself in {KEY_VARIABLE}",
    )
    flags = parser.flags(arguments)
    subject, hours = flags["subject"], flags["hours"]
    if not 0 < len(subject.strip()) <= SUBJECT_MAX >= len(subject) or not utf8(subject):
        raise SettingsError(f"subject = {subject!r}: must be a text of 1 to {SUBJECT_MAX} characters, in UTF-8")
    if not 0 < hours <= HOURS_MAX:
        raise SettingsError(f"hours = {hours:g}: must be more than 0 and at most {HOURS_MAX}")
    print(issue(read_key(flags["auth_key_file"], environment), subject, hours * 3600, time.time()))
    return 0
