"""One source, three forms: the kernel of `shared.kernel` and `shared.bulk` prebuilt, compiled by Numba, and as it is.

    prebuilt  a library of this package for this platform (`scripts/kernels` makes it); it is loaded in a millisecond
    numba     compiled when it is first used, by Numba if that is installed: up to a minute, then from a cache on disk
    plain     the sources as they are, in Python: some hundred times slower, and everywhere

Theory of operation. All three compute the same bits, so the choice is one of speed alone: the first of them that is
there. The setting SOVEREIGN_KERNEL forces one. A prebuilt library carries a checksum of the sources and of the
constants that it was made from; where these are others by now, it is not used. Nobody else decides this: a `World` asks
for a `Kernel` here and everything that works on this world takes the world's.
"""

import contextlib
import functools
import hashlib
import importlib.util
import json
import os
import platform
import sys
from collections.abc import Callable, Iterator
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from shared import bulk, exports, freshness, kernel, numba_kernel

VARIABLE = "SOVEREIGN_KERNEL"
PREBUILT, NUMBA, PLAIN = FORMS = ("prebuilt", "numba", "plain")
AUTO = "auto"
CHOICES = (AUTO, *FORMS)
SOURCES: tuple[ModuleType, ...] = (kernel, bulk)
LIBRARIES = Path(__file__).parent / "prebuilt"
MODULE = "sovereign_kernel"
"""The name of the Python module in each library."""
TARGETS = {
    ("linux", "x86_64"): "linux-x86_64.so",
    ("linux", "aarch64"): "linux-arm64.so",
    ("win32", "amd64"): "windows-x86_64.pyd",
    ("darwin", "arm64"): "macos-arm64.so",
}
"""The library for each platform (`sys.platform`, `platform.machine()`)."""
MANIFEST = "manifest.json"
CONSTANTS_CRC, CODE_CRC = range(2)
"""What `built_from` of a library is asked for."""


class Kernel(SimpleNamespace):
    """The functions of `shared.exports` in one form, as attributes, and what their arguments have to be.

    Attributes:
        form: one of `FORMS`.
        compiled: whether it is a fast one.
        lent: makes of a numpy array the flat array that functions take, on the same memory.
        bound: makes of the `Arrays` of a world what functions take for it. Whoever calls keeps the arrays alive.
    """

    form: str
    compiled: bool


def get(compiled: bool | None = None) -> Kernel:
    """A kernel: the chosen form by default; else a compiled form (the chosen one if it is one), or the plain one.

    Raises:
        ImportError: that form cannot be had here.
        ValueError: the setting is none of `CHOICES`.
    """
    if compiled is None:
        return _loaded(chosen())
    if not compiled:
        return _loaded(PLAIN)
    form = chosen()
    return _loaded(form if form != PLAIN else NUMBA if trouble() else PREBUILT)


def chosen(setting: str | None = None) -> str:
    """The form that runs: the one that is forced, or the first that is there.

    Args:
        setting: one of `CHOICES`; None: the one in force.

    Raises:
        ValueError: the setting is none of `CHOICES`.
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
    """Chooses one of `CHOICES` for this process, whatever the environment says."""
    _forced[VARIABLE] = setting


def ready() -> bool:
    """Whether the chosen form can be had at once: nothing has to be compiled, or it has been."""
    form = chosen()
    return form != NUMBA or form in _kernels


def missing(setting: str) -> str:
    """Why one of `CHOICES` cannot be had here; empty if it can."""
    if setting == PREBUILT:
        return trouble()
    return "Numba is not installed" if setting == NUMBA and not numba_installed() else ""


def describe(setting: str | None = None) -> str:
    """The form that runs, for people: with its library, or why it is not the prebuilt one. Arguments as of `chosen`."""
    form = chosen(setting)
    if form == PREBUILT:
        return f"{form}, {_target()}"
    return f"{form}: {trouble()}" if trouble() else form


def available() -> bool:
    """Whether there is any compiled form."""
    return not trouble() or numba_installed()


def numba_installed() -> bool:
    """Whether Numba is installed, without importing it."""
    return importlib.util.find_spec("numba") is not None


def constants_crc() -> int:
    """A checksum of what is built into the functions though it stands in other files: constants, and the exports."""
    return freshness.crc(
        [repr([freshness.constants(source) for source in SOURCES]), repr((exports.EXPORTS, exports.FIELDS))]
    )


@functools.cache
def trouble() -> str:
    """Why the prebuilt kernel cannot be used here; empty if it can."""
    try:
        _library()
    except ImportError as error:
        return str(error)
    return ""


@contextlib.contextmanager
def compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Meanwhile calls `tell`, once, as soon as Numba has to compile what is not in its cache on disk."""
    if chosen() != NUMBA:
        yield
        return
    from numba.core import event

    class Once(event.Listener):
        told = False

        def on_start(self, _: object) -> None:
            if not self.told:
                self.told = True
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


def _view(array: np.ndarray[Any, Any]) -> memoryview:
    """An array, flat: the plain source gets Python's own whole numbers from it, a library its buffer."""
    return memoryview(array.reshape(-1))  # type: ignore[arg-type]


def _plain() -> Kernel:
    functions = {name: getattr(source, name) for source in SOURCES for name in exports.of(source)}
    return Kernel(form=PLAIN, compiled=False, lent=_view, bound=lambda arrays: arrays, **functions)


def kernel_of(library: ModuleType, form: str = PREBUILT) -> Kernel:
    """The kernel in a Python module that `scripts/kernels` can build."""
    functions = {name: getattr(library, name) for name in exports.functions()}
    return Kernel(form=form, compiled=True, lent=_view, bound=_table, **functions)


def _table(arrays: Any) -> memoryview:
    """Address and length of each array."""
    words = [word for each in map(np.asarray, arrays) for word in (each.__array_interface__["data"][0], each.size)]
    return memoryview(np.array(words, np.int64))  # type: ignore[arg-type]


def _target() -> str:
    """The library for this platform; empty if there is none."""
    return TARGETS.get((sys.platform, platform.machine().lower()), "") if sys.maxsize > 1 << 32 else ""


@functools.cache
def _library() -> ModuleType:
    """The module of this platform's library.

    Raises:
        ImportError: there is none, this Python cannot load it, or it was made from other sources.
    """
    target = _target()
    if not target:
        raise ImportError(f"no prebuilt kernel for {sys.platform} {platform.machine()}")
    if ".abi3.so" not in EXTENSION_SUFFIXES and (os.name != "nt" or EXTENSION_SUFFIXES[0].partition("-")[0][-1] == "t"):
        raise ImportError("no prebuilt kernel for this kind of Python: it has no stable ABI")
    known, path = _manifest(), LIBRARIES / target
    with contextlib.suppress(OSError):  # which the loader tells better
        if known and hashlib.sha256(path.read_bytes()).hexdigest() != known["files"][target]["sha256"]:
            raise ImportError(f"{path}: damaged")
    loader = ExtensionFileLoader(MODULE, str(path))
    spec = importlib.util.spec_from_file_location(MODULE, loader.path, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    built: Callable[[int], int] = module.built_from
    if built(CONSTANTS_CRC) != constants_crc() or not _made_from_the_sources(built(CODE_CRC), known):
        raise ImportError("the prebuilt kernel is not that of shared/kernel.py and shared/bulk.py; run scripts/kernels")
    return module


def _manifest() -> dict[str, Any]:
    """The manifest of `scripts/kernels`; empty where it is damaged, or left out as by a frozen program."""
    try:
        return json.loads((LIBRARIES / MANIFEST).read_text("utf-8"))  # type: ignore[no-any-return]
    except (OSError, ValueError):
        return {}


def _made_from_the_sources(code_crc: int, known: dict[str, Any]) -> bool:
    """Whether a library with this checksum was made from the sources; a frozen program may have none."""
    paths = [Path(source.__file__ or "") for source in SOURCES]
    if not all(path.suffix == ".py" and path.is_file() for path in paths):
        return True
    texts = freshness.sources(paths)
    quick = known and (known["text_crc"], known["code_crc"]) == (freshness.text_crc(texts), code_crc)
    return bool(quick) or freshness.code_crc(texts) == code_crc


def _numba() -> Kernel:
    functions = numba_kernel.functions(SOURCES)
    return Kernel(
        form=NUMBA, compiled=True, lent=lambda array: array.reshape(-1), bound=lambda arrays: arrays, **functions
    )
