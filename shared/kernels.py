"""The choice of the kernel: the sources of the kernel (`SOURCES`) in three forms.

    prebuilt  a library of this package for this platform (`scripts/kernels` makes it); it loads in a millisecond
    numba     compiled at its first use, by Numba if that is installed: up to a minute, then from a cache on disk
    plain     the sources as they are, in Python: about 200 times slower, but available everywhere

Theory of operation. All three forms compute the same bits, so the choice affects speed alone: the first form that is
available is used. The setting SOVEREIGN_KERNEL forces one. A prebuilt library carries a checksum of the sources and
constants that it was made from; if these have changed, it is not used. This module alone makes the choice: a `World`
gets its `Kernel` here, and all code that works on this world uses the world's kernel.
"""

import contextlib
import functools
import hashlib
import importlib.util
import json
import os
import platform
import sys
from array import array
from collections.abc import Callable, Iterator
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from shared import bulk, delivery, exports, freshness, kernel, numba_kernel, pacing, places, traffic, wasm_kernel

VARIABLE = "SOVEREIGN_KERNEL"
"""Name of the environment variable that forces a form."""
PREBUILT, NUMBA, PLAIN = FORMS = ("prebuilt", "numba", "plain")
"""Forms of the kernel."""
AUTO = "auto"
"""Setting that takes the first form that is available."""
CHOICES = (AUTO, *FORMS)
"""Values of the setting."""
SOURCES: tuple[ModuleType, ...] = (kernel, bulk, traffic, delivery, pacing, places)
"""Modules that the kernel is made from."""
LIBRARIES = Path(__file__).parent / "prebuilt"
"""Folder of the prebuilt libraries."""
MODULE = "sovereign_kernel"
"""Name of the Python module in each library."""
TARGETS = {
    ("linux", "x86_64"): "linux-x86_64.so",
    ("linux", "aarch64"): "linux-arm64.so",
    ("win32", "amd64"): "windows-x86_64.pyd",
    ("darwin", "arm64"): "macos-arm64.so",
    ("emscripten", "wasm32"): "kernel-emscripten.so",
}
"""File name of the library for each platform (`sys.platform`, `platform.machine()`)."""
MANIFEST = "manifest.json"
"""File name of the list of libraries with their checksums."""
IN_BROWSER = sys.platform == "emscripten"
"""Whether this is Pyodide."""
CONSTANTS_CRC, CODE_CRC = range(2)
"""Arguments of a library's function `built_from`: which checksum it returns."""


class Kernel(SimpleNamespace):
    """One form of the kernel: the functions of `shared.exports` as attributes, and converters for their arguments.

    Attributes:
        form: one of `FORMS`.
        compiled: whether the form is a compiled one.
        lent: returns the flat array that functions take for an array of `shared.arrays`; both share the memory.
        bound: returns the value that functions take for the `Arrays` of a world. The caller has to keep the arrays
            alive.
    """

    form: str
    compiled: bool


def get(compiled: bool | None = None) -> Kernel:
    """Returns a kernel.

    Args:
        compiled: None: the chosen form; True: a compiled form (the chosen one if it is compiled); False: the plain one.

    Raises:
        ImportError: that form is not available here.
        ValueError: the setting is not one of `CHOICES`.
    """
    if compiled is None:
        return _loaded(chosen())
    if not compiled:
        return _loaded(PLAIN)
    form = chosen()
    return _loaded(form if form != PLAIN else NUMBA if trouble() else PREBUILT)


def chosen(setting: str | None = None) -> str:
    """Returns the form that is used: the forced one, or the first that is available.

    Args:
        setting: one of `CHOICES`; None: the setting in force.

    Raises:
        ValueError: the setting is not one of `CHOICES`.
    """
    setting = setting or _forced.get(VARIABLE) or os.environ.get(VARIABLE) or AUTO
    if setting not in CHOICES:
        raise ValueError(f"{VARIABLE} = {setting!r}: must be one of {', '.join(CHOICES)}")
    if setting != AUTO:
        return setting
    if not trouble():
        return PREBUILT
    return NUMBA if numba_installed() else PLAIN


def force(setting: str) -> None:
    """Sets one of `CHOICES` for this process; it takes precedence over the environment variable."""
    _forced[VARIABLE] = setting


def ready() -> bool:
    """Returns whether the chosen form is available at once, without waiting for a compiler."""
    form = chosen()
    return form != NUMBA or form in _kernels


def missing(setting: str) -> str:
    """Returns the reason why one of `CHOICES` is not available here; empty if it is."""
    if setting == PREBUILT:
        return trouble()
    return "Numba is not installed" if setting == NUMBA and not numba_installed() else ""


def describe(setting: str | None = None) -> str:
    """Returns a text with the form that is used, and its library, or the reason why it is not the prebuilt one.

    Args:
        setting: one of `CHOICES`; None: the setting in force.
    """
    form = chosen(setting)
    if form == PREBUILT:
        return f"{form}, {_target()}"
    return f"{form}: {trouble()}" if trouble() else form


def available() -> bool:
    """Returns whether a compiled form is available."""
    return not trouble() or numba_installed()


def numba_installed() -> bool:
    """Returns whether Numba is installed, without importing it."""
    return importlib.util.find_spec("numba") is not None


def constants_crc() -> int:
    """Returns a checksum of what a library contains from other files: constants and the table of exports."""
    return freshness.crc(
        [repr([freshness.constants(source) for source in SOURCES]), repr((exports.EXPORTS, exports.FIELDS))]
    )


@functools.cache
def trouble() -> str:
    """Returns the reason why the prebuilt kernel cannot be used here; empty if it can."""
    try:
        _library()
    except ImportError as error:
        return str(error)
    return ""


@contextlib.contextmanager
def compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Returns a context in which `tell` is called once, when Numba begins to compile what its cache does not have."""
    if chosen() != NUMBA:
        yield
        return
    from numba.core import event

    class Once(event.Listener):
        reported = False

        def on_start(self, _: object) -> None:
            if not self.reported:
                self.reported = True
                tell()

        def on_end(self, _: object) -> None:
            pass

    with event.install_listener("numba:compile", Once()):
        yield


# -- the forms -----------------------------------------------------------------------------------------------

_forced: dict[str, str] = {}
_kernels: dict[str, Kernel] = {}


def _loaded(form: str) -> Kernel:
    if form not in _kernels:
        _kernels[form] = {PREBUILT: lambda: kernel_of(_library()), NUMBA: _numba, PLAIN: _plain}[form]()
    return _kernels[form]


def _view(array: Any) -> memoryview:
    """Returns a flat view of an array. The plain sources read Python's own numbers from it, a library its buffer."""
    view: memoryview = array.reshape(-1).data
    return view


def _plain() -> Kernel:
    functions = {name: getattr(source, name) for source in SOURCES for name in exports.of(source)}
    return Kernel(form=PLAIN, compiled=False, lent=_view, bound=lambda arrays: arrays, **functions)


def kernel_of(library: ModuleType, form: str = PREBUILT) -> Kernel:
    """Returns the kernel in a Python module that `scripts/kernels` builds."""
    functions = {name: getattr(library, name) for name in exports.functions(server=not IN_BROWSER)}
    if IN_BROWSER:
        return Kernel(form=form, compiled=True, lent=wasm_kernel.lent, bound=wasm_kernel.bound, **functions)
    return Kernel(form=form, compiled=True, lent=_view, bound=_table, **functions)


def _table(arrays: Any) -> memoryview:
    """Returns a table with the address and the length of each array."""
    words = array("q")
    for view in arrays:
        words.append(wasm_kernel.address_of(view))
        words.append(len(view))
    return memoryview(words)


def _target() -> str:
    """Returns the file name of the library for this platform; empty if there is none."""
    if not IN_BROWSER and sys.maxsize <= 1 << 32:
        return ""
    return TARGETS.get((sys.platform, platform.machine().lower()), "")


@functools.cache
def _library() -> ModuleType:
    """Returns the module in this platform's library.

    Raises:
        ImportError: there is no library, this Python cannot load it, it is damaged, or was made from other sources.
    """
    target = _target()
    if not target:
        raise ImportError(f"no prebuilt kernel for {sys.platform} {platform.machine()}")
    if not _loads_libraries():
        raise ImportError("no prebuilt kernel for this kind of Python: it has no stable ABI")
    known, path = _manifest(), LIBRARIES / target
    with contextlib.suppress(OSError):  # the loader reports a missing file with a better message
        if known and hashlib.sha256(path.read_bytes()).hexdigest() != known["files"][target]["sha256"]:
            raise ImportError(f"{path}: damaged")
    module = wasm_kernel.loaded(path) if IN_BROWSER else _extension(path)
    built: Callable[[int], int] = module.built_from
    if built(CONSTANTS_CRC) != constants_crc() or not _made_from_the_sources(built(CODE_CRC), known):
        raise ImportError(
            "the prebuilt kernel was not made from the present shared/kernel.py, bulk.py, traffic.py, delivery.py, "
            "pacing.py and places.py; run scripts/kernels"
        )
    return module


def _loads_libraries() -> bool:
    """Returns whether this Python can load the library of its platform."""
    if IN_BROWSER or ".abi3.so" in EXTENSION_SUFFIXES:
        return True
    return os.name == "nt" and EXTENSION_SUFFIXES[0].partition("-")[0][-1] != "t"


def _extension(path: Path) -> ModuleType:
    """Loads the Python module in a library.

    Raises:
        ImportError: it cannot be loaded.
    """
    loader = ExtensionFileLoader(MODULE, str(path))
    spec = importlib.util.spec_from_file_location(MODULE, loader.path, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def _manifest() -> dict[str, Any]:
    """Returns the manifest of `scripts/kernels`; empty if it is damaged, or missing (in a frozen program)."""
    try:
        return json.loads((LIBRARIES / MANIFEST).read_text("utf-8"))  # type: ignore[no-any-return]
    except (OSError, ValueError):
        return {}


def source_hash() -> str:
    """Returns a hash of the physics. Programs with equal hashes compute the same worlds, in any form of the kernel."""
    known = _manifest()
    texts = _source_texts()
    if texts is None or (known and known["text_crc"] == freshness.text_crc(texts)):
        code_crc = known.get("code_crc", 0)
    else:
        code_crc = freshness.code_crc(texts)
    return f"{code_crc:08x}{constants_crc():08x}"


def _source_texts() -> list[str] | None:
    """Returns the texts of the sources; None: there are no source files, as in a frozen program."""
    paths = [Path(source.__file__ or "") for source in SOURCES]
    return freshness.sources(paths) if all(path.suffix == ".py" and path.is_file() for path in paths) else None


def _made_from_the_sources(code_crc: int, known: dict[str, Any]) -> bool:
    """Returns whether a library with this checksum was made from the sources.

    Also true if there are no source files to compare with, as in a frozen program.
    """
    texts = _source_texts()
    if texts is None:
        return True
    quick = known and (known["text_crc"], known["code_crc"]) == (freshness.text_crc(texts), code_crc)
    return bool(quick) or freshness.code_crc(texts) == code_crc


def _numba() -> Kernel:
    functions = numba_kernel.functions(SOURCES)
    return Kernel(
        form=NUMBA, compiled=True, lent=lambda array: array.reshape(-1), bound=lambda arrays: arrays, **functions
    )
