"""Plays a game in a browser: starts a server with bots if none is given, and opens its page /play."""

import contextlib
import signal
import subprocess
import sys
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlencode, urlsplit, urlunsplit

from client_sdk.transports.common import ConnectError
from server.play.bundles import runtime_folder
from sovereign_netcode.play import own_server
from sovereign_netcode.play.options import arguments

FETCH = Path(__file__).parents[2] / "scripts" / "browser"
"""The command of a checkout that fetches Python for browsers."""


def main(argv: list[str] | None = None, open_page: Callable[[str], object] = webbrowser.open) -> int:
    """Plays until Ctrl-C. Returns the exit code."""
    options = arguments(argv)
    if options.picture or options.script_demo:
        print("error: --browser takes no --picture and no --script-demo", file=sys.stderr)
        return 2
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C, so that the server and the bots end, too
    try:
        if options.url is None:
            fetch()
        with contextlib.ExitStack() as stack:
            url = options.url
            if url is None:
                print("starting a server ...", flush=True)
                url = stack.enter_context(
                    own_server.server(options.game, options.scene, options.option, reload=options.reload)
                )
            count = options.bots if options.bots is not None else 0 if options.url else 4
            stack.enter_context(own_server.bots(url, count, options.game))
            page = page_of(url, name=options.name, lag=f"{options.lag:g}" if options.lag else "")
            print(f"play at {page} (Ctrl-C ends it)", flush=True)
            open_page(page)
            with contextlib.suppress(KeyboardInterrupt):
                for _ in forever():
                    pass
        return 0
    except (ConnectError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0


def forever() -> Iterator[None]:
    """Waits for a signal."""
    while True:
        signal.pause() if hasattr(signal, "pause") else input()
        yield


def fetch() -> None:
    """Fetches Python for browsers in a checkout, unless it is there.

    Raises:
        RuntimeError: it cannot be fetched, or this package was built without it.
    """
    if runtime_folder() is not None:
        return
    if not FETCH.is_file():
        raise RuntimeError("this package was built without Python for browsers; scripts/browser of a checkout makes it")
    if subprocess.run([sys.executable, str(FETCH)], check=False).returncode:
        raise RuntimeError("Python for browsers cannot be fetched")


def page_of(url: str, **query: str) -> str:
    """Returns the address of the page to play on, for the WebSocket address of a server or a world.

    Args:
        url: the address.
        query: further fields of the page's address; empty ones are left out.
    """
    parts = urlsplit(url)
    path = parts.path + (f"?{parts.query}" if parts.query else "")
    fields = {"at": "" if path == "/" else path, **query}
    secure = "s" if parts.scheme == "wss" else ""
    shown = urlencode({name: value for name, value in fields.items() if value})
    return urlunsplit((f"http{secure}", parts.netloc, "/play", shown, ""))
