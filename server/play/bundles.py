"""The files that a browser gets: groups of files under addresses that name a hash of their content.

    /play/HASH/play.js     so a browser may keep each file for ever, and files of a group find each other by name

All files are compressed when they are read, or have been before, and never for a request.
"""

import gzip
import hashlib
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
"""Folder that has the packages `client_sdk`, `server` and `shared`: that of a checkout, or `sovereign_netcode`."""
WEB = (HERE / "web", ROOT / "client_sdk" / "web")
"""Folders with the files of the page and of the client in JavaScript."""
RUNTIME = (HERE / "runtime", ROOT / "build" / "browser")
"""Folders that may have Python for browsers: that of an installed package, and that of `scripts/browser`."""
LAST = "stamp.json"
"""File of that folder that is written last."""
KERNELS = ROOT / "shared" / "prebuilt"
TYPES = {
    "js": "text/javascript; charset=utf-8",
    "mjs": "text/javascript; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "wasm": "application/wasm",
    "json": "application/json",
    "zip": "application/zip",
}
"""Content types by the end of a name."""
HASH_DIGITS = 16


class File(NamedTuple):
    """A file in memory, compressed, with its length before that."""

    packed: bytes
    length: int
    content_type: str


class Bundle(NamedTuple):
    """Files under one address, which ends with a slash."""

    address: str
    files: Mapping[str, File]

    @property
    def sizes(self) -> dict[str, int]:
        """The lengths of the files, by address."""
        return {self.address + name: file.length for name, file in self.files.items()}


def bundle(packed: Mapping[str, bytes]) -> Bundle:
    """Returns a bundle of files that are compressed already (gzip)."""
    digest = hashlib.sha256()
    for name, data in sorted(packed.items()):
        digest.update(b"%s\0%d\0" % (name.encode(), len(data)) + data)
    files = {
        name: File(data, int.from_bytes(data[-4:], "little"), TYPES[name.rpartition(".")[2]])
        for name, data in packed.items()
    }
    return Bundle(f"/play/{digest.hexdigest()[:HASH_DIGITS]}/", files)


def page_bundle() -> Bundle:
    """Returns the scripts and styles of the page, and the kernel for them."""
    paths = [path for folder in WEB for path in sorted(folder.iterdir()) if path.suffix in (".js", ".css")]
    return bundle({path.name: pack(path.read_bytes()) for path in (*paths, KERNELS / "kernel.wasm")})


def runtime_folder() -> Path | None:
    """Returns the folder that has Python for browsers; None: there is none."""
    return next((folder for folder in RUNTIME if (folder / LAST).is_file()), None)


def runtime_bundle(folder: Path) -> Bundle:
    """Returns Python for browsers."""
    return bundle({path.stem: path.read_bytes() for path in sorted(folder.glob("*.gz"))})


def source_bundle() -> Bundle:
    """Returns the sources of the client and of what it shares with the server, as an archive `sources.zip`."""
    found: dict[str, bytes] = {}
    for name in ("client_sdk", "shared"):
        for path in (ROOT / name).rglob("*.py"):
            found[path.relative_to(ROOT).as_posix()] = path.read_bytes()
    for name in ("kernel-emscripten.so", "manifest.json"):
        found[f"shared/prebuilt/{name}"] = (KERNELS / name).read_bytes()
    if not (ROOT / "sovereign_netcode").is_dir():  # installed: the packages are within it
        found["__init__.py"] = (ROOT / "__init__.py").read_bytes()
        found = {f"sovereign_netcode/{name}": data for name, data in found.items()}
    else:
        for name in ("__init__.py", "_checkout.py"):
            found[f"sovereign_netcode/{name}"] = (ROOT / "sovereign_netcode" / name).read_bytes()
    return bundle({"sources.zip": pack(archive(found))})


def archive(files: Mapping[str, bytes]) -> bytes:
    """Returns a zip archive with fixed times and without compression of its own."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as made:
        for name in sorted(files):
            made.writestr(zipfile.ZipInfo(name, (2024, 1, 1, 0, 0, 0)), files[name])
    return data.getvalue()


def pack(data: bytes) -> bytes:
    """Returns data compressed for HTTP (gzip)."""
    return gzip.compress(data, 9, mtime=0)
