"""`sovereign-server check`: whether a server is ready, as an exit code, for containers and service managers."""

import http.client
import os
import ssl
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence

from server.config.options import Parser, SettingsError
from server.net.addresses import bracketed, reachable

TIME_OUT_S = 3.0


def main(arguments: Sequence[str], environment: Mapping[str, str] = os.environ) -> int:
    """Asks a server's `/readyz`; 0 if it is ready, else 1. Prints what it says.

    Raises:
        SettingsError: the address is none.
    """
    host = bracketed(reachable(environment.get("SOVEREIGN_HOST", "127.0.0.1").strip("[]")))
    port = environment.get("SOVEREIGN_PORT", "8765")
    scheme = "https" if "SOVEREIGN_TLS_CERT" in environment else "http"
    parser = Parser(
        prog="sovereign-server check", description="Exit code 0 if the server is ready for players.", allow_abbrev=False
    )
    default = f"{scheme}://{host}:{port}/readyz"
    parser.add_argument("--url", default=default, help=f"what to ask, or just ws://HOST:PORT (default: {default})")
    url = page(parser.flags(arguments)["url"])
    # It asks whether the server works, often by another name than the one in its certificate: nothing is kept secret.
    trusting = ssl.create_default_context()
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=trusting))
    try:
        with opener.open(url, timeout=TIME_OUT_S) as answer:
            print(answer.read(1000).decode(errors="replace").strip())
        return 0
    except urllib.error.HTTPError as error:
        with error:
            print(error.read(1000).decode(errors="replace").strip() or error.code)
    except (OSError, ValueError, http.client.HTTPException) as error:
        print(f"no answer from {url} ({getattr(error, 'reason', None) or error})")
    return 1


def page(url: str) -> str:
    """The address of a page: of `/readyz` where none is named, also for an address that players use."""
    scheme, colon, rest = url.partition("://")
    scheme = {"ws": "http", "wss": "https"}.get(scheme, scheme)
    host, _, path = rest.partition("/")
    if scheme not in ("http", "https") or not host:
        raise SettingsError(f"url = {url!r}: must be like ws://HOST:PORT, wss://, http:// or https://")
    return f"{scheme}{colon}{host}/{path or 'readyz'}"
