"""Makes the files of Python for browsers in build/browser. A checkout's server and the built wheel hand them out.

Fetches Pyodide (by npm) and the wheels of requirements-browser.txt (by pip), 6 MB; both are pinned by their hashes.
"""

from __future__ import annotations

import argparse
import sys
import time

from scripts.browser_build import runtime, tools
from scripts.browser_build.packages import FetchError, npm_package, wheels


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="scripts/browser", description=__doc__, allow_abbrev=False)
    parser.add_argument(
        "--tests", action="store_true", help="also fetch what tests need and is missing: Node.js, Chromium, three.js"
    )
    parser.add_argument("--again", action="store_true", help="make the files again, even if they are there")
    args = parser.parse_args(arguments)
    started = time.monotonic()
    try:
        if args.tests:
            for_tests()
        if runtime.ready() and not args.again:
            print(f"{runtime.OUT}: ready")
            return 0
        runtime.make(npm_package("pyodide"), wheels())
    except FetchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    size = sum(file.stat().st_size for file in runtime.OUT.iterdir())
    print(f"{runtime.OUT}: {size / 1e6:.1f} MB compressed, made in {time.monotonic() - started:.0f} s")
    return 0


def for_tests() -> None:
    """Fetches what tests in Node.js and in a browser need and this machine does not have.

    Raises:
        FetchError: a package cannot be fetched.
    """
    print(f"Node.js: {tools.node()}")
    npm_package("three")
    if tools.browser() is None:
        tools.unpack_chromium(npm_package("@sparticuz/chromium"))
    print(f"browser: {tools.browser()}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
