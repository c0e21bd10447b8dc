"""The command `sovereign-server check`: asks a server whether it is ready, for containers and service managers."""

import http.client
import os
import ssl
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence

from server.config.options import Parser, SettingsError
from server.net.addresses import bracketed, reachable

TIME_OUT_S = 3.0
"""Seconds that the check waits for an answer."""


def main(arguments: Sequence[str], environment: Mapping[str, str] = os.environ) -> int:
    """Runs `sovereign-server check`: requests `/readyz` of a server and prints the answer.

    Returns:
        The exit code: 0 if the server is ready, otherwise 1.

    Raises:
        SettingsError: the given address is not a URL.
    """
    host = bracketed(reachable(environment.get("SOVEREIGN_HOST", "127.0.0.1").strip("[]")))
    port = environment.get("SOVEREIGN_PORT", "8765")
    scheme = "https" if "SOVEREIGN_TLS_CERT" in environment else "http"
    parser = Parser(
        prog="sovereign-server check", description="Exit code 0 if the server is ready for players.", allow_abbrev=False
    )
    default = f"{scheme}://{host}:{port}/readyz"
    parser.add_argument("--url", default=default, help=f"page to request, or only ws://HOST:PORT (default: {default})")
    url = page(parser.flags(arguments)["url"])
    # The certificate is not checked: the check often uses another name than the certificate's, and sends no secrets.
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
    """Returns the URL of a page; `/readyz` if the given URL names none. Accepts ws:// and wss://, too.

    Raises:
        SettingsError: it is not a URL of these kinds.
    """
    scheme, colon, rest = url.partition("://")
    scheme = {"ws": "http", "wss": "https"}.get(scheme, scheme)
    host, _, path = rest.partition("/")
    if scheme not in ("http", "https") or not host:
        raise SettingsError(f"url = {url!r}: must be like ws://HOST:PORT, wss://, http:// or https://")
    return f"{scheme}{colon}{host}/{path or 'readyz'}"
