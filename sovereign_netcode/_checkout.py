"""The alias of a checkout: `sovereign_netcode.server.game` is the module `server.game`, one object under two names.

The wheel has the folders client_sdk/, server/ and shared/ within `sovereign_netcode`, and does not have this file
(see hatch_build.py). In a checkout they stand beside `sovereign_netcode`, and the finder below maps the names.
"""

import importlib.util
import sys
import warnings
from collections.abc import Iterable, Sequence
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import CodeType, ModuleType

PACKAGE = __name__.partition(".")[0]
ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("client_sdk", "server", "shared")
HINT = f"rename the module, or install {PACKAGE} instead of using its checkout (pip install {ROOT})"


class AliasFinder(MetaPathFinder):
    """Finds `sovereign_netcode.server...` as `server...`, and `server` in this checkout from any current folder."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname in FOLDERS:
            return PathFinder.find_spec(fullname, [str(ROOT)])
        package, _, name = fullname.partition(".")
        if package != PACKAGE or name.partition(".")[0] not in FOLDERS:
            return None
        own = importlib.util.find_spec(name)
        if own is None:
            return None
        is_package = own.submodule_search_locations is not None
        spec = ModuleSpec(fullname, AliasLoader(own), origin=own.origin, is_package=is_package)
        spec.has_location = own.has_location
        return spec


class AliasLoader(InspectLoader):
    """Puts the module that `own` describes in place of the alias module."""

    def __init__(self, own: ModuleSpec) -> None:
        self.own = own

    def exec_module(self, module: ModuleType) -> None:
        # The import system returns what is in `sys.modules` after this call.
        sys.modules[module.__name__] = importlib.import_module(self.own.name)

    def is_package(self, fullname: str) -> bool:
        return self.own.submodule_search_locations is not None

    def get_code(self, fullname: str) -> CodeType | None:  # for `python -m sovereign_netcode.server`
        return self._loader().get_code(self.own.name)

    def get_source(self, fullname: str) -> str | None:
        return self._loader().get_source(self.own.name)

    def _loader(self) -> InspectLoader:
        assert isinstance(self.own.loader, InspectLoader)
        return self.own.loader


def install() -> None:
    """Makes the import system ask `AliasFinder` first. Warns if that hides a module of the program.

    Raises:
        ImportError: another module with the name of one of `FOLDERS` is already imported.
    """
    for name in FOLDERS:
        there, place = sys.modules.get(name), ROOT / name
        if there is not None and not _is_at(place, getattr(there, "__path__", None)):
            raise ImportError(
                f"{PACKAGE} in a checkout needs the name {name!r} for {place}, but it is {there!r}: {HINT}"
            )
        found = PathFinder.find_spec(name)
        if found is not None and not _is_at(place, found.submodule_search_locations):
            warnings.warn(f"{found.origin} cannot be imported, because {place} has the same name: {HINT}", stacklevel=3)
    if not any(isinstance(finder, AliasFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, AliasFinder())


def _is_at(place: Path, locations: Iterable[str] | None) -> bool:
    """Returns whether one of a package's `locations` is the folder `place`."""
    return any(Path(location).resolve() == place for location in locations or ())
