"""From settings to what decides on players, and to what speaks TLS for the server."""

import importlib
import os
import ssl
from typing import Any

from server import tokens
from server.auth import Authenticator
from server.kinds import SettingsError
from server.rules import RulesError, checked_function
from server.settings import Settings


def authenticator(settings: Settings) -> Authenticator | None:
    """What decides on players, as the settings say; None: whoever comes may play.

    Raises:
        SettingsError: there is no key, or no such object.
    """
    if settings.auth == "none":
        return None
    if settings.auth == "token":
        return tokens.Tokens(tokens.read_key(settings.auth_key_file, os.environ))
    module, _, name = settings.auth.partition(":")
    try:
        found: Any = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, TypeError, ValueError) as error:  # the latter two: no name of a module
        raise SettingsError(f"auth = {settings.auth!r}: cannot be used ({error})") from error
    if isinstance(found, type):
        raise SettingsError(f"auth = {settings.auth!r}: is a class; name a function, or an object that can be called")
    try:
        checked_function(found, f"auth = {settings.auth!r}")
    except RulesError as error:
        raise SettingsError(str(error)) from error
    checked: Authenticator = found
    return checked


def tls_context(settings: Settings) -> ssl.SSLContext | None:
    """What speaks TLS for the server; None: nothing does.

    Raises:
        SettingsError: a file cannot be used.
    """
    if settings.tls_cert is None or settings.tls_key is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(settings.tls_cert, settings.tls_key)
    except OSError as error:  # an SSLError is one
        files = f"tls_cert = {settings.tls_cert!r}, tls_key = {settings.tls_key!r}"
        raise SettingsError(f"{files}: cannot be used ({error.strerror or error})") from error
    return context
