"""The sources of the client as one zip archive, which a page unpacks into Pyodide.

    python -m sovereign_netcode.browser.bundle OUT.zip

It has client_sdk and shared under their names in this installation, so `sovereign_netcode.client_sdk.browser` is
importable where the archive is unpacked. It has the kernel for Pyodide, and no other library. The same files give the
same bytes.
"""

import io
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import sovereign_netcode
from sovereign_netcode import client_sdk, shared

LIBRARIES = ("kernel-emscripten.so", "manifest.json")
"""Files of the folder `prebuilt` that a page needs."""
NEVER = ("async_client.py", "connection.py", "polling.py", "loopback.py", "compiling.py")
"""Modules of the client that need a socket, a thread or a server."""
LONG_AGO = (1980, 1, 1, 0, 0, 0)
"""Time of all files in the archive."""


def bundle() -> bytes:
    """Returns the archive."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, path in sorted(_files()):
            entry = zipfile.ZipInfo(name, LONG_AGO)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, path.read_bytes(), compresslevel=9)
    return out.getvalue()


def _files() -> Iterator[tuple[str, Path]]:
    """Yields the name in the archive and the path of each file."""
    own = Path(sovereign_netcode.__file__).parent
    for name in ("__init__.py", "_checkout.py"):  # the second one exists in a checkout only
        if (own / name).is_file():
            yield f"{own.name}/{name}", own / name
    for package in (client_sdk, shared):
        folder = Path(package.__file__ or "").parent
        prefix = f"{own.name}/{folder.name}" if folder.parent == own else folder.name
        for path in folder.rglob("*"):
            within = path.relative_to(folder)
            library = within.parts[0] == "prebuilt"
            if path.name in LIBRARIES if library else path.suffix in (".py", ".toml") and path.name not in NEVER:
                yield f"{prefix}/{within.as_posix()}", path


def main() -> None:
    """Writes the archive to the file that the command line names."""
    made = bundle()
    Path(sys.argv[1]).write_bytes(made)
    print(f"{sys.argv[1]}: {len(made):,} bytes")


if __name__ == "__main__":
    main()
