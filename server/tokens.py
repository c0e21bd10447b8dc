"""Signed tokens (JWT, HS256) with a subject and an expiry: who may come in, until when; and issuing them."""

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jwt

from server.auth import SUBJECT_MAX, AuthError
from server.kinds import Parser, SettingsError
from shared.checks import text, utf8

ALGORITHM = "HS256"
KEY_BYTES_MIN = 32
"""HS256 is as strong as its key: one shorter than its digest is refused."""
KEY_VARIABLE = "SOVEREIGN_AUTH_KEY"
"""The key itself, in the environment; there is no flag for it, since everybody can see those."""
LEEWAY_S = 5.0
"""So much may the clocks of who issues and of who checks differ."""
HOURS_MAX = 24 * 366


class Tokens:
    """Checks tokens; an `Authenticator`.

    Args:
        key: with which they must be signed.
        clock: seconds since 1970.
    """

    def __init__(self, key: bytes, clock: Callable[[], float] = time.time) -> None:
        self._key = key
        self._clock = clock
        self._signatures = jwt.PyJWS(algorithms=[ALGORITHM])

    def __call__(self, token: str) -> str:
        """The subject of a token.

        Raises:
            AuthError: it is none, it is not signed with the key, or it is not its time.
        """
        if not token:
            raise AuthError("this server asks for a token")
        claims, now = self._signed(token), self._clock()
        expiry, begin = _time(claims, "exp"), _time(claims, "nbf")
        if expiry is None:
            raise AuthError("the token has no expiry")
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
            raise AuthError(f"the token's subject {subject!r} is not a text that UTF-8 can hold")
        return subject

    def _signed(self, token: str) -> dict[str, Any]:
        try:
            claims = json.loads(self._signatures.decode(token, self._key, algorithms=[ALGORITHM]))
        except jwt.InvalidSignatureError:
            raise AuthError("the token is signed with another key") from None
        except jwt.InvalidAlgorithmError:
            raise AuthError(f"the token is not signed by {ALGORITHM}") from None
        except (jwt.PyJWTError, ValueError, TypeError, RecursionError):
            raise AuthError("this is no token") from None
        if not isinstance(claims, dict):
            raise AuthError("this is no token")
        return claims


def _time(claims: Mapping[str, Any], name: str) -> float | None:
    """A claim in seconds since 1970; None if there is none.

    Raises:
        AuthError: it is no number.
    """
    value = claims.get(name)
    if value is None:
        return None
    if type(value) not in (int, float) or not -1e15 < value < 1e15 or math.isnan(value):
        raise AuthError(f"the token's {name} is no time")
    return float(value)


def issue(key: bytes, subject: str, seconds: float, now: float) -> str:
    """A token for a subject, valid for so long from now (seconds since 1970) on.

    Raises:
        SceneError: the subject is too long, or no text that UTF-8 can hold.
    """
    text(subject, "subject", SUBJECT_MAX)
    return jwt.encode({"sub": subject, "iat": int(now), "exp": math.ceil(now + seconds)}, key, ALGORITHM)


def read_key(path: str | None, environment: Mapping[str, str]) -> bytes:
    """The key in a file, without space around it; without a file, that in the environment.

    Raises:
        SettingsError: there is none, or it is too short.
    """
    if path is None:
        origin, key = KEY_VARIABLE, environment.get(KEY_VARIABLE, "").encode(errors="surrogateescape")
        if not key:
            raise SettingsError(f"auth_key_file is not set, and neither is {KEY_VARIABLE}: tokens need a key")
    else:
        origin = f"auth_key_file = {path!r}"
        try:
            key = Path(path).read_bytes().strip()
        except OSError as error:
            raise SettingsError(f"{origin}: cannot be read ({error.strerror or error})") from error
    if len(key) < KEY_BYTES_MIN:
        raise SettingsError(f"{origin}: a key has {KEY_BYTES_MIN} bytes or more, like that of: openssl rand -hex 32")
    return key


def main(arguments: Sequence[str], environment: Mapping[str, str] = os.environ) -> int:
    """`sovereign-server token`: prints a token.

    Raises:
        SettingsError: the key or an argument cannot be used.
    """
    parser = Parser(
        prog="sovereign-server token", description="Issues a token that lets a player in.", allow_abbrev=False
    )
    parser.add_argument("--subject", required=True, help=f"who the player is, up to {SUBJECT_MAX} characters")
    parser.add_argument("--hours", type=float, default=24.0, help="how long the token is valid (default: 24)")
    parser.add_argument(
        "--auth-key-file", default=environment.get("SOVEREIGN_AUTH_KEY_FILE"), help=f"the key; or {KEY_VARIABLE}"
    )
    flags = parser.flags(arguments)
    subject, hours = flags["subject"], flags["hours"]
    if not 0 < len(subject.strip()) <= SUBJECT_MAX >= len(subject) or not utf8(subject):
        raise SettingsError(f"subject = {subject!r}: must be a text of 1 to {SUBJECT_MAX} characters, in UTF-8")
    if not 0 < hours <= HOURS_MAX:
        raise SettingsError(f"hours = {hours:g}: must be more than 0 and at most {HOURS_MAX}")
    print(issue(read_key(flags["auth_key_file"], environment), subject, hours * 3600, time.time()))
    return 0
