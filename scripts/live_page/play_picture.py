"""Takes the pictures of the page /play for the README: tag at the size of a desktop, dodge at that of a phone.

    python -m scripts.live_page.play_picture OUT.png URL [--phone]

A server with the game runs at URL. The player walks a little before the picture is taken.
"""

import argparse
import time
from pathlib import Path

from scripts.live_page.chromium import chromium, installed

JOIN_S = 240.0
WALK_S = 8.0
DESKTOP, PHONE = (1280, 720), (390, 844)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("url", help="address of the server, like http://127.0.0.1:8765")
    parser.add_argument("--phone", action="store_true")
    args = parser.parse_args()
    browser = installed()
    if browser is None:
        print("error: there is no Chromium on this machine")
        return 1
    with chromium(browser) as tab:
        if args.phone:
            tab.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=5)
        width, height = PHONE if args.phone else DESKTOP
        tab.open(f"{args.url}/play?name=Ann", width, height, phone=args.phone)
        tab.until("globalThis.play?.view?.me && play.client.shared.ends", JOIN_S)
        for code in ("KeyD", "KeyS"):
            tab.call("Input.dispatchKeyEvent", type="keyDown", code=code, key=code[-1].lower())
        time.sleep(WALK_S)
        args.out.write_bytes(tab.picture())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
