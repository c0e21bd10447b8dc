"""A headless Chromium, driven by the DevTools protocol."""

import base64
import json
import os
import re
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any

from websockets.sync.client import ClientConnection, connect

from scripts.browser_build import tools

FLAGS = (
    "--headless --disable-gpu --disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync --hide-scrollbars --remote-debugging-port=0"
).split()
START_S = 60.0
ANSWER_S = 30.0


def installed() -> str | None:
    """Returns the path of a Chromium or Chrome; None if there is none."""
    return tools.browser()


class Tab:
    """A page of the browser."""

    def __init__(self, link: ClientConnection) -> None:
        self._link = link
        self._numbers = count(1)
        self.said: list[str] = []
        """Exceptions of the page, and lines of its console and log, so far."""
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Returns the answer to a call of the protocol."""
        number = next(self._numbers)
        self._link.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            told = json.loads(self._link.recv(ANSWER_S))
            if told.get("id") == number:
                assert "error" not in told, (method, told["error"])
                return dict(told["result"])
            if told.get("method") in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
                self.said.append(json.dumps(told["params"])[:2000])

    def open(
        self, url: str, width: int, height: int, *, scale: float = 1.0, dark: bool = False, phone: bool = False
    ) -> None:
        """Goes to a page, in a window of `width` x `height` pixels, or on a phone with such a screen."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=phone
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Page.navigate", url=url)

    def run(self, script: str) -> Any:
        """Returns the value of an expression in the page. A promise is awaited."""
        done = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def until(self, script: str, seconds: float = ANSWER_S) -> Any:
        """Waits until an expression is true and raises nothing. Returns its value."""
        deadline = time.monotonic() + seconds
        while True:
            done = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
            value = None if "exceptionDetails" in done else done["result"].get("value")
            if value:
                return value
            assert time.monotonic() < deadline, (script, done, self.said)
            time.sleep(0.05)

    def picture(self) -> bytes:
        """Returns a picture of the page as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])


@contextmanager
def chromium(path: str, *flags: str) -> Iterator[Tab]:
    """Runs a browser with an empty profile and further flags. Yields its only page, which is empty."""
    root = ("--no-sandbox",) if hasattr(os, "geteuid") and os.geteuid() == 0 else ()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = subprocess.Popen(
            [path, *FLAGS, *flags, *root, f"--user-data-dir={profile}", "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | tools.libraries(path),
        )
        try:
            with connect(_page(_address(browser)), compression=None, max_size=None) as link:
                yield Tab(link)
        finally:
            browser.kill()
            browser.wait()
            assert browser.stderr is not None
            browser.stderr.close()


def _address(browser: subprocess.Popen[str]) -> str:
    """Returns host and port of the DevTools protocol, which the browser prints."""
    assert browser.stderr is not None
    line = ""
    for line in browser.stderr:
        found = re.search(r"DevTools listening on ws://([^/]+)/", line)
        if found:
            return found[1]
    raise RuntimeError(f"the browser ended before it listened, with {browser.wait()}: {line.strip()}")


def _page(address: str) -> str:
    """Returns the WebSocket address of the browser's page."""
    import urllib.request

    deadline = time.monotonic() + START_S
    while True:
        with urllib.request.urlopen(f"http://{address}/json/list", timeout=START_S) as answer:
            pages = [each for each in json.load(answer) if each["type"] == "page"]
        if pages:
            return str(pages[0]["webSocketDebuggerUrl"])
        assert time.monotonic() < deadline
        time.sleep(0.05)
