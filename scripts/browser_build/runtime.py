"""The files of Python for browsers: Pyodide's own, a smaller standard library, and msgpack; all compressed once.

The standard library is compiled here, because compiling it takes a browser seconds at each start. Modules that no
client needs are left out (`LEFT_OUT`): a game's behaviours may import all others.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import json
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

from scripts.browser_build.packages import NPM, PINS, FetchError
from scripts.browser_build.tools import node
from scripts.environment import ROOT
from server.play import bundles

OUT = ROOT / "build" / "browser"
"""Folder of the files."""
STAMP = "stamp.json"
"""Name of the file that says what the others were made from."""
TAKEN = ("pyodide.mjs", "pyodide.asm.mjs", "pyodide.asm.wasm")
"""Files of Pyodide that are handed out as they are."""
LIBRARY = "python_stdlib.zip"
"""Name of the standard library, without compression of its own."""
PACKAGES = "packages.zip"
"""Name of the archive with the wheels' modules."""
LEFT_OUT = frozenset(
    """_markupbase _pyio _pyrepl _strptime antigravity argparse bdb cmd code compileall configparser cProfile csv curses
    dbm difflib doctest email ensurepip filecmp fileinput ftplib getopt getpass gettext html http idlelib imaplib
    importlib/metadata importlib/resources importlib/simple.py lib2to3 logging/config.py logging/handlers.py
    mailbox mimetypes modulefinder multiprocessing netrc nturl2path optparse pdb pickletools plistlib poplib
    pprint profile pstats pty py_compile pyclbr pydoc pydoc_data quopri rlcompleter runpy sched shelve smtplib
    socketserver sqlite3 stringprep symtable tabnanny tarfile test this timeit tkinter trace tracemalloc tty
    turtle turtledemo unittest urllib/error.py urllib/request.py urllib/response.py urllib/robotparser.py uuid venv wave
    webbrowser wsgiref xml xmlrpc zipapp zoneinfo""".split()
)
"""Modules and packages of the standard library that are left out."""
ENCODINGS = frozenset(
    "__init__ aliases ascii cp437 idna latin_1 punycode unicode_escape utf_16 utf_8 utf_8_sig".split()
)
"""Modules of the package `encodings` that are kept."""
COMPILE = Path(__file__).with_name("compile.mjs")


def ready() -> bool:
    """Returns whether the files are there, made from the present pins by the present code."""
    try:
        return (OUT / STAMP).read_text("utf-8") == _stamp()
    except OSError:
        return False


def make(pyodide: Path, wheels: list[Path]) -> None:
    """Makes the files.

    Args:
        pyodide: folder of the npm package.
        wheels: wheels for the same Python.

    Raises:
        FetchError: the standard library cannot be compiled.
    """
    print("compiling the standard library for browsers ...", flush=True)
    library = _compiled(pyodide, bundles.archive(dict(_library(pyodide / LIBRARY))))
    packages = bundles.archive({name: data for each in wheels for name, data in _wheel(each)})
    lock = json.loads((pyodide / "pyodide-lock.json").read_text("utf-8"))
    files = {name: (pyodide / name).read_bytes() for name in TAKEN}
    files["pyodide-lock.json"] = json.dumps({"info": lock["info"], "packages": {}}).encode()
    files |= {LIBRARY: library, PACKAGES: packages}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=OUT.parent) as place:
        made = Path(place) / OUT.name
        made.mkdir()
        for name, data in files.items():
            (made / f"{name}.gz").write_bytes(gzip.compress(data, 9, mtime=0))
        (made / STAMP).write_text(_stamp(), "utf-8")
        shutil.rmtree(OUT, ignore_errors=True)
        with contextlib.suppress(OSError):  # another process was faster
            made.rename(OUT)


def _stamp() -> str:
    code = hashlib.sha256(b"\0".join(Path(each).read_bytes() for each in (__file__, COMPILE, PINS))).hexdigest()
    return json.dumps({"pyodide": NPM["pyodide"], "code": code})


def _library(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yields the modules of Pyodide's standard library that are kept."""
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            first, _, rest = entry.filename.partition("/")
            second = f"{first}/{rest.partition('/')[0]}"
            if entry.is_dir() or first.removesuffix(".py") in LEFT_OUT or second in LEFT_OUT:
                continue
            if first == "encodings" and rest.removesuffix(".py") not in ENCODINGS:
                continue
            yield entry.filename, archive.read(entry)


def _wheel(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yields the modules of a wheel."""
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.filename.endswith((".py", ".so")):
                yield entry.filename, archive.read(entry)


def _compiled(pyodide: Path, sources: bytes) -> bytes:
    """Returns the archive with compiled modules in place of sources, compiled by the same Python, in Node.js.

    Raises:
        FetchError: Node.js cannot be had, or fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "in.zip", Path(folder) / "out.zip"
        given.write_bytes(sources)
        command = (node(), str(COMPILE), str(pyodide), str(given), str(made))
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise FetchError(f"compiling the standard library: {(done.stderr or done.stdout)[-2000:]}")
        return made.read_bytes()
