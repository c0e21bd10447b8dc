"""Checks of settings that depend on each other."""

from typing import TYPE_CHECKING

from server.config.hosts import ANY, is_loopback
from server.config.options import SettingsError
from shared import kernels

if TYPE_CHECKING:
    from server.config.settings import Settings


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
    if settings.role == "server":
        for name, given in (("bus", settings.bus), ("public_url", settings.public_url)):
            if given is not None:
                raise SettingsError(f"{name} (from {settings.origins[name]}): needs role as well")
        return
    role = f"role = {settings.role!r} (from {settings.origins['role']})"
    if settings.bus is None:
        raise SettingsError(f"{role}: needs bus as well")
    if settings.public_url is not None and settings.role != "edge":
        raise SettingsError(f"public_url (from {settings.origins['public_url']}): is for role edge only")
    for name in ("data", "reload", "worlds"):
        if getattr(settings, name):
            raise SettingsError(f"{role}: excludes {name}; the world is saved on the bus")
