"""The directories of saved worlds: DATA/worlds/NAME has `world.json` and the store of one world.

`world.json` is written before the store, and before anything of a world is promised to a client. So a directory with it
is a world, whatever ended the process, and one without it was not one yet. A world that ends is renamed before its
files are removed, and the rest is removed at the next start.
"""

import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from server.players.ticket import Property
from server.worlds.fleet_entries import FOLDER
from server.worlds.kinds import WorldsError, checked_name, checked_properties

FORMAT = 1
"""Version of the format of `world.json`."""
COPIED = ("world.db", "world.db-wal", "world.mark", "world.json")
"""Files of a world, in the order in which they are copied."""
ENDED = ".ended-"
"""Beginning of the name of a directory whose world has ended."""

logger = logging.getLogger(__name__)


class SavedWorld(NamedTuple):
    """The state of a saved world beside its store.

    `kind` is the name of its kind. `asleep` says whether it has ended and comes back when a player joins.
    """

    kind: str
    properties: dict[str, Property]
    code: str
    locked: bool
    asleep: bool


class WorldFiles:
    """The directories of all saved worlds.

    Args:
        data: the directory of the server's data.
        durable: whether `world.json` survives a power cut.
        shared: whether other processes use the directory, too.

    Raises:
        OSError: the directory cannot be made.
    """

    def __init__(self, data: Path, *, durable: bool, shared: bool = False) -> None:
        self._folder, self._failed, self._durable = data / "worlds", data / "failed-worlds", durable
        self.folders: dict[str, str] = {}
        """Names of directories of worlds that are not called like their world."""
        self._folder.mkdir(parents=True, exist_ok=True)
        if shared:
            return
        for path in self._folder.iterdir():
            begun = path.is_dir() and not (path / "world.json").exists() and not (path / "world.db").exists()
            if begun or path.name.startswith(ENDED):  # no client has been promised anything of a world that only begun
                shutil.rmtree(path, ignore_errors=True)

    def of(self, name: str) -> Path:
        """Returns the directory of a world."""
        return self._folder / self.folders.get(name, name)

    def write(self, name: str, world: SavedWorld) -> None:
        """Writes `world.json` of a world.

        Raises:
            OSError: it cannot be written.
        """
        folder = self.of(name)
        folder.mkdir(exist_ok=True)
        new = folder / "world.json-new"
        with new.open("w", encoding="utf-8") as file:
            json.dump({"format": FORMAT, **world._asdict()}, file)
            if self._durable:
                file.flush()
                os.fsync(file.fileno())
        new.replace(folder / "world.json")

    def saved(self) -> Iterator[tuple[str, SavedWorld]]:
        """Yields all saved worlds: their names, and what `world.json` has. Logs those that cannot be used."""
        for path in sorted(self._folder.iterdir(), key=lambda path: (len(path.name), path.name)):
            try:
                yield checked_name(path.name, "world"), _read(path / "world.json")
            except (OSError, ValueError, TypeError) as error:
                logger.error("the saved world in %s cannot be used: %s", path, error)

    def remove(self, name: str) -> None:
        """Removes the directory of a world that has ended, if there is one, and former ones."""
        self._remove(self.of(name))
        if name in self.folders:
            self.remove_former(name, self.folders.pop(name))

    def _remove(self, path: Path) -> None:
        ended = self._free(self._folder / f"{ENDED}{path.name}")
        try:
            path.rename(ended)
        except FileNotFoundError:
            return
        shutil.rmtree(ended, ignore_errors=True)

    def read(self, name: str) -> SavedWorld | None:
        """Returns what `world.json` of a world has; None: there is none.

        Raises:
            OSError, ValueError: it cannot be read, or is damaged.
        """
        path = self.of(name) / "world.json"
        return _read(path) if path.exists() else None

    def copy(self, folder: str, new: str) -> None:
        """Copies the directory of a world that another process may have open and cannot change any more.

        Args:
            folder: name of the directory.
            new: name of the copy.

        Raises:
            OSError: it cannot be copied.
        """
        target = self._folder / new
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir()
        for name in COPIED:  # the last one makes it a world
            path = self._folder / folder / name
            if path.exists() or name == COPIED[-1]:
                shutil.copyfile(path, target / name)
                if self._durable:
                    with (target / name).open("rb") as file:
                        os.fsync(file.fileno())

    def newest(self) -> dict[str, tuple[str, SavedWorld]]:
        """Returns the newest directory of each saved world, and what `world.json` has, by name."""
        found: dict[str, tuple[int, str]] = {}
        for path in self._folder.iterdir():
            name, _, number = path.name.partition("@")
            if FOLDER.fullmatch(path.name) and (path / "world.json").exists():
                found[name] = max(found.get(name, (-1, "")), (int(number or 0), path.name))
        worlds = {}
        for name, (_, folder) in found.items():
            try:
                worlds[name] = folder, _read(self._folder / folder / "world.json")
            except (OSError, ValueError, TypeError) as error:
                logger.error("the saved world in %s cannot be used: %s", self._folder / folder, error)
        return worlds

    def remove_former(self, name: str, folder: str) -> None:
        """Removes the directories of a world that are older than the one it has now."""
        newest = int(folder.partition("@")[2] or 0)
        for path in (self._folder / name, *self._folder.glob(f"{name}@*")):
            number = path.name.partition("@")[2] or "0"
            if path.name != folder and number.isdecimal() and int(number) < newest and path.exists():
                self._remove(path)

    def set_aside(self, name: str) -> Path:
        """Moves the directory of a world that has failed out of the way. Returns its new place."""
        self._failed.mkdir(exist_ok=True)
        return self.of(name).rename(self._free(self._failed / name))

    def _free(self, path: Path) -> Path:
        """Returns the path, or one with a number behind it that does not exist."""
        number, found = 1, path
        while found.exists():
            number += 1
            found = path.with_name(f"{path.name}-{number}")
        return found


def _read(path: Path) -> SavedWorld:
    """Reads a `world.json`.

    Raises:
        OSError: it cannot be read.
        ValueError: it has another format, or is damaged.
    """
    table: Any = json.loads(path.read_text("utf-8"))
    if not isinstance(table, Mapping) or table.get("format") != FORMAT:
        raise WorldsError(f"{path.name} is not of format {FORMAT}")
    values: dict[str, Any] = {name: table.get(name) for name in SavedWorld._fields}
    for name, kind in SavedWorld.__annotations__.items():
        wanted = {"properties": dict}.get(name, kind)
        if type(values[name]) is not wanted:
            raise WorldsError(f"{path.name}: {name} = {values[name]!r} is of another type")
    return SavedWorld(**values)._replace(properties=checked_properties(values["properties"]))
