"""Zones: boxes of the world that report which entities enter and leave them. A zone stops nothing.

An entity is inside if its box and the zone overlap; boxes that only touch do not. Only entities that have changed are
compared, with all zones at once.
"""

from typing import Any

import numpy as np

from server.game_api.boxes import Boxes
from server.game_api.entries import Entries
from shared.checks import SceneError, shown, vector
from shared.layout import ID, Int64s
from shared.units import to_position
from shared.world import World

ZONES_MAX = 256
"""Maximum number of zones of a game."""

Visit = tuple[str, int]
"""A zone and an entity."""


class Zones:
    """The zones of one game.

    Args:
        world: the world.
        entries: the corners of the zones by name, in grid steps, as part of the persisted state.
    """

    def __init__(self, world: World, entries: Entries) -> None:
        self._world, self._entries = world, entries
        self._boxes = Boxes(world.scene)
        self._visits: set[Visit] = set()
        self._new: list[str] = []
        """Zones that were added or moved since the last update."""
        if self:
            self._visits = set(self._found(world.states(), list(entries.table)))

    def __bool__(self) -> bool:
        return bool(self._entries.table)

    def add(self, name: str, low: Any, high: Any) -> None:
        """Adds a zone, or moves an existing one.

        Raises:
            SceneError: there are too many zones, or a corner is wrong.
        """
        corners = [
            [to_position(part, at) for part in vector(corner, at)] for corner, at in ((low, "low"), (high, "high"))
        ]
        if not all(a < b for a, b in zip(*corners, strict=True)):
            raise SceneError(f"low = {shown(low)}, high = {shown(high)}: each part of low must be below that of high")
        if name not in self._entries.table and len(self._entries.table) >= ZONES_MAX:
            raise SceneError(f"zone {name!r}: more than {ZONES_MAX} zones")
        self._entries.put(name, corners)
        self._new.append(name)

    def remove(self, name: str) -> None:
        """Removes a zone. Entities inside do not leave it.

        Raises:
            SceneError: there is no such zone.
        """
        self._known(name)
        self._entries.drop(name)
        self._visits = {visit for visit in self._visits if visit[0] != name}

    def inside(self, name: str) -> list[int]:
        """Returns the entities that are inside a zone now, in ascending order.

        Raises:
            SceneError: there is no such zone.
        """
        return sorted(entity for _, entity in self._found(self._world.states(), [self._known(name)]))

    def update(self, changed: Int64s) -> tuple[list[Visit], list[Visit]]:
        """Compares the entities inside zones with those of the last call.

        Args:
            changed: the entities that a step, or the rules after it, have changed since the last call.

        Returns:
            The visits that have ended, also because the entity is gone, and those that have begun, both ascending.
        """
        states, names = self._world.states(), list(self._entries.table)
        now = set(self._found(states[np.isin(states[:, ID], changed)], names)) if len(changed) else set()
        new = {name for name in self._new if name in self._entries.table}
        self._new.clear()
        if new:
            now.update(self._found(states, sorted(new)))
        moved = set(changed.tolist())
        ended = {
            (name, entity)
            for name, entity in self._visits - now
            if entity in moved or name in new or entity not in self._world
        }
        begun = now - self._visits
        self._visits = (self._visits - ended) | now
        return sorted(ended), sorted(begun)

    def forget(self, visit: Visit) -> None:
        """Forgets a visit that was not reported, because the entity was removed first."""
        self._visits.discard(visit)

    def _known(self, name: str) -> str:
        if name not in self._entries.table:
            raise SceneError(f"zone = {shown(name)}: there is no such zone")
        return name

    def _found(self, states: Int64s, names: list[str]) -> list[Visit]:
        """Returns the visits of the given entities to the given zones."""
        if not names or not len(states):
            return []
        corners = np.array([self._entries.table[name] for name in names], np.int64)
        low, high = self._boxes.corners(states)
        inside = ((low[:, None] < corners[None, :, 1]) & (high[:, None] > corners[None, :, 0])).all(axis=2)
        rows, zones = np.nonzero(inside)
        ids = states[:, ID]
        return [(names[zone], int(ids[row])) for row, zone in zip(rows.tolist(), zones.tolist(), strict=True)]
