"""Checks of settings that depend on each other."""

import re
from typing import TYPE_CHECKING

from server.config.hosts import ANY, is_loopback
from server.config.options import SettingsError
from shared import kernels

if TYPE_CHECKING:
    from server.config.settings import Settings

FLEET = re.compile("[A-Za-z0-9_-]{1,32}")
"""Pattern of the name of a fleet."""
KIND_MAX = 24
"""Longest name of a kind in a fleet, because the names of its worlds name their process, too."""


def check_together(settings: "Settings") -> None:
    """Checks the settings that depend on each other.

    Raises:
        SettingsError: a combination cannot be used.
    """
    host = settings.host
    if "auth" not in settings.origins and not (host == "localhost" or is_loopback(host)):
        raise SettingsError(
            f"host = {host!r} (from {settings.origins['host']}): other machines can connect, so say who may play: "
            "--auth token, or --auth none for anyone"
        )
    if settings.auth not in ("none", "token") and not all(settings.auth.partition(":")):
        raise SettingsError(
            f"auth = {settings.auth!r} (from {settings.origins['auth']}): must be none, token, or MODULE:NAME"
        )
    for name in settings.allowed_hosts:
        if any(sign in name for sign in ":/[]*") and name != ANY:
            raise SettingsError(
                f"allowed_hosts = {name!r} (from {settings.origins['allowed_hosts']}): must be a host name, without "
                f"scheme and port, or {ANY} for all"
            )
    _check_role(settings)
    if settings.options and settings.game is None:
        name = next(iter(settings.options))
        raise SettingsError(
            f"option {name} (from {settings.origins[f'option {name}']}): is of a game; give --game, too"
        )
    if why := kernels.missing(settings.kernel):
        raise SettingsError(f"kernel = {settings.kernel!r} (from {settings.origins['kernel']}): {why}")
    if (settings.tls_cert is None) != (settings.tls_key is None):
        given, missing = ("tls_cert", "tls_key") if settings.tls_key is None else ("tls_key", "tls_cert")
        raise SettingsError(f"{given} (from {settings.origins[given]}): needs {missing} as well")


def _check_role(settings: "Settings") -> None:
    """Checks the settings of a part of a world on many processes.

    Raises:
        SettingsError: a combination cannot be used.
    """
    if settings.role == "server" and settings.fleet is not None:
        _check_fleet(settings)
        return
    if settings.fleet is not None:
        raise SettingsError(f"fleet (from {settings.origins['fleet']}): is for role server only")
    if settings.role == "server":
        for name, given in (("bus", settings.bus), ("public_url", settings.public_url)):
            if given is not None:
                raise SettingsError(f"{name} (from {settings.origins[name]}): needs role or fleet as well")
        return
    role = f"role = {settings.role!r} (from {settings.origins['role']})"
    if settings.bus is None:
        raise SettingsError(f"{role}: needs bus as well")
    if settings.public_url is not None and settings.role != "edge":
        raise SettingsError(f"public_url (from {settings.origins['public_url']}): is for role edge only")
    for name in ("data", "reload", "worlds"):
        if getattr(settings, name):
            raise SettingsError(f"{role}: excludes {name}; the world is saved on the bus")


def _check_fleet(settings: "Settings") -> None:
    """Checks the settings of a process of a fleet.

    Raises:
        SettingsError: a combination cannot be used.
    """
    fleet = f"fleet = {settings.fleet!r} (from {settings.origins['fleet']})"
    if not FLEET.fullmatch(settings.fleet or ""):
        raise SettingsError(f"{fleet}: must be 1 to 32 letters, digits, - and _")
    if settings.bus is None:
        raise SettingsError(f"{fleet}: needs bus as well")
    if not settings.worlds:
        raise SettingsError(f"{fleet}: needs kinds of worlds, such as [worlds.arena] in the file of settings")
    if settings.reload:
        raise SettingsError(f"{fleet}: excludes reload")
    for name in settings.worlds:
        if len(name) > KIND_MAX:
            raise SettingsError(f"worlds.{name}: in a fleet, the name of a kind has at most {KIND_MAX} characters")
