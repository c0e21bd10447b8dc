"""The authenticator and the TLS context that the settings of a server name."""

import importlib
import os
import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from server.auth.identity import Authenticator
from server.config.options import SettingsError
from server.config.settings import OPERATOR_VARIABLE, Settings
from server.rules import RulesError, checked_function

TOKEN_MIN = 16
"""Minimum length of the token of operators, in characters."""


def authenticator(settings: Settings) -> Authenticator | None:
    """Returns the authenticator that the setting `auth` names; None: anyone may play.

    Raises:
        SettingsError: there is no key for tokens, or `auth` names nothing that can be called.
    """
    if settings.auth == "none":
        return None
    if settings.auth == "token":
        from server.auth import tokens  # its library takes a tenth of a server's start

        return tokens.Tokens(tokens.read_key(settings.auth_key_file, os.environ))
    module, _, name = settings.auth.partition(":")
    try:
        found: Any = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, TypeError, ValueError) as error:  # the last two: not the name of a module
        raise SettingsError(f"auth = {settings.auth!r}: cannot be used ({error})") from error
    if isinstance(found, type):
        raise SettingsError(f"auth = {settings.auth!r}: is a class; name a function or another callable object")
    try:
        checked_function(found, f"auth = {settings.auth!r}")
    except RulesError as error:
        raise SettingsError(str(error)) from error
    checked: Authenticator = found
    return checked


def operator_token(path: str | None, environment: Mapping[str, str]) -> str:
    """Returns the token of operators; empty if there is none.

    Args:
        path: a file with the token, of which leading and trailing spaces are ignored; None: read `OPERATOR_VARIABLE`.
        environment: the environment variables.

    Raises:
        SettingsError: the token cannot be read, is too short, or has other characters than visible ones of ASCII.
    """
    if path is None:
        origin, token = OPERATOR_VARIABLE, environment.get(OPERATOR_VARIABLE, "")
        if not token:
            return ""
    else:
        origin = f"operator_token_file = {path!r}"
        try:
            token = Path(path).read_text("utf-8").strip()
        except (OSError, ValueError) as error:
            raise SettingsError(f"{origin}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(token) < TOKEN_MIN or not token.isascii() or not token.isprintable() or " " in token:
        raise SettingsError(
            f"{origin}: must have at least {TOKEN_MIN} visible characters of ASCII, as made by: openssl rand -hex 32"
        )
    return token


def tls_context(settings: Settings) -> ssl.SSLContext | None:
    """Returns the TLS context with the certificate of the settings; None: the server does not use TLS.

    Raises:
        SettingsError: the certificate or its key cannot be used.
    """
    if settings.tls_cert is None or settings.tls_key is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(settings.tls_cert, settings.tls_key)
    except OSError as error:  # an SSLError is an OSError, too
        files = f"tls_cert = {settings.tls_cert!r}, tls_key = {settings.tls_key!r}"
        raise SettingsError(f"{files}: cannot be used ({error.strerror or error})") from error
    return context
