"""What exists in a world and by which numbers: validated, and the same on both sides by fingerprint."""

import functools
import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from shared import layout
from shared.bounds import TICK_RATE_MAX
from shared.checks import Cell, SceneError, Vec, boolean, cell, choice, finite, items, shown, text, vector, whole
from shared.inputs import MOVE_MAX
from shared.units import RANGE_BLOCKS, SEGMENT, SPEED, rounded, to_position, to_velocity

TEMPLATES_MAX = 255
SEGMENTS_MAX = 1 << 16
BOX_MAX = 32.0
"""No box is longer, in blocks."""
REACH_MAX = 1024.0
INTEGRATORS = ("mean", "semi")
SHOWN = ("interpolated", "predicted")

SCENES = Path(__file__).parent / "scenes"


def _own_numbers(owner: Any) -> None:
    """Puts Python's own numbers in the place of numpy's, which MessagePack cannot hold."""
    for f in fields(owner):
        value = getattr(owner, f.name)
        if isinstance(value, np.generic):
            object.__setattr__(owner, f.name, value.item())


@dataclass(frozen=True)
class Template:
    """A kind of entity. Lengths in blocks, speeds in blocks/s.

    Args:
        box_offset: displacement of the box's corner from the entity's position.
        box_size: the sides of the box; a negative one extends the box the other way (the seed's y).
        walk_speed: an entity of this template moves by its move intent; 0: it keeps its velocity instead.
        jump_speed: upward speed of a jump; 0: it cannot.
        solid: whether solid entities stop each other (and stand on each other); blocks stop all.
        shown: how clients draw those of others: "interpolated" (as they were a moment ago) or "predicted" (as they
            are now, if they go on as they did).
    """

    name: str
    box_offset: Vec = (-0.3, -0.3, 0.0)
    box_size: Vec = (0.6, 0.6, 1.8)
    walk_speed: float = 0.0
    jump_speed: float = 0.0
    solid: bool = True
    shown: str = "interpolated"

    def __post_init__(self) -> None:
        _own_numbers(self)
        at = f"templates.{text(self.name, 'templates.name')}"
        offset = vector(self.box_offset, f"{at}.box_offset")
        size = vector(self.box_size, f"{at}.box_size")
        for axis, offset_k, size_k in zip("xyz", offset, size, strict=True):
            if to_position(size_k, f"{at}.box_size.{axis}") == 0:
                raise SceneError(f"{at}.box_size.{axis} = {size_k!r}: must not be zero")
            if abs(size_k) > BOX_MAX or abs(offset_k) > BOX_MAX:
                raise SceneError(f"{at}.box: {axis} reaches further than {BOX_MAX:g} blocks")
        for name in ("walk_speed", "jump_speed"):
            if to_velocity(getattr(self, name), f"{at}.{name}") < 0:
                raise SceneError(f"{at}.{name} = {getattr(self, name)!r}: must not be negative")
        boolean(self.solid, f"{at}.solid")
        choice(self.shown, f"{at}.shown", SHOWN)
        object.__setattr__(self, "box_offset", offset)
        object.__setattr__(self, "box_size", size)

    def row(self) -> list[int]:
        """The row of `layout.Arrays.templates`: the box normalised to its low corner and positive sides."""
        low, sides = [], []
        for axis, offset, size in zip("xyz", self.box_offset, self.box_size, strict=True):
            ends = sorted((to_position(offset, axis), to_position(offset, axis) + to_position(size, axis)))
            low.append(ends[0])
            sides.append(ends[1] - ends[0])
        return [*low, *sides, self.solid, self.walk_speed > 0, to_velocity(self.jump_speed, "jump_speed")]


@dataclass(frozen=True)
class Scene:
    """The rules and the extent of a world. What is switched off costs nothing.

    Args:
        tick_rate: ticks per second, 1 to 240.
        gravity: downward acceleration in blocks/s^2; 0: there is no gravity (nor support, nor jumps).
        terminal_speed: the fastest fall, in blocks/s.
        integrator: "mean" moves by the mean of the old and the new fall speed (exact for constant acceleration),
            "semi" by the new one (the seed's rule).
        entity_collision: whether solid entities stop each other.
        size: the extent of the world in segments of 32 blocks; (0, 0, 0) has its low corner at `origin`.
        origin: index of the lowest segment.
        terrain: the generator's name under "generator", and its parameters.
        spawns: where players appear, in turn.
        player: the name of the template of players.
        reach: how far from its position a player may place and remove blocks, in blocks to their centres; 0: nowhere.
    """

    name: str
    templates: tuple[Template, ...] = (Template("player", walk_speed=3.0, jump_speed=8.0),)
    tick_rate: int = 32
    gravity: float = 18.0
    terminal_speed: float = 16.0
    integrator: str = "mean"
    entity_collision: bool = True
    size: Cell = (4, 4, 1)
    origin: Cell = (0, 0, 0)
    terrain: Mapping[str, Any] = field(default_factory=lambda: {"generator": "flat"})
    spawns: tuple[Vec, ...] = ((64.0, 64.0, 8.0),)
    player: str = "player"
    reach: float = 6.0

    def __repr__(self) -> str:
        """Short, for events show it; all of it is `to_table`."""
        blocks = " x ".join(str(SEGMENT * part) for part in self.size)
        return f"<Scene {self.name!r}, {blocks} blocks, {self.tick_rate} ticks/s>"

    def __post_init__(self) -> None:
        _own_numbers(self)
        text(self.name, "name")
        whole(self.tick_rate, "tick_rate", 1, TICK_RATE_MAX)
        for name in ("gravity", "terminal_speed"):
            if finite(getattr(self, name), name) < 0:
                raise SceneError(f"{name} = {getattr(self, name)!r}: must not be negative")
        to_velocity(self.terminal_speed, "terminal_speed")
        to_velocity(self.gravity / self.tick_rate, "gravity")
        if self.gravity > 0 and rounded(self.gravity * SPEED / self.tick_rate) == 0:
            raise SceneError(f"gravity = {self.gravity!r}: vanishes in one tick; 0 switches it off")
        if self.gravity > 0 and to_velocity(self.terminal_speed, "terminal_speed") == 0:
            raise SceneError(f"terminal_speed = {self.terminal_speed!r}: nothing could fall; set gravity = 0 instead")
        choice(self.integrator, "integrator", INTEGRATORS)
        boolean(self.entity_collision, "entity_collision")
        if not 0 <= finite(self.reach, "reach") <= REACH_MAX:
            raise SceneError(f"reach = {self.reach!r}: must be 0 to {REACH_MAX:g}")
        object.__setattr__(self, "size", cell(self.size, "size", 1, SEGMENTS_MAX))
        limit = RANGE_BLOCKS // SEGMENT
        object.__setattr__(self, "origin", cell(self.origin, "origin", -limit, limit - 1))
        if max(low + side for low, side in zip(self.origin, self.size, strict=True)) > limit:
            raise SceneError(f"origin = {self.origin}, size = {self.size}: reaches further than {RANGE_BLOCKS} blocks")
        if self.size[0] * self.size[1] * self.size[2] > SEGMENTS_MAX:
            raise SceneError(f"size = {self.size}: more than {SEGMENTS_MAX} segments")
        terrain: object = self.terrain
        if not isinstance(terrain, Mapping) or not isinstance(terrain.get("generator"), str):
            raise SceneError(f"terrain = {shown(terrain)}: must be a table with a generator")
        for key, value in terrain.items():
            text(key, "terrain: the name of a parameter")
            try:
                msgpack.packb(_plain(value))
            except (TypeError, ValueError, OverflowError, RecursionError) as error:
                raise SceneError(f"terrain.{key} = {shown(value)}: cannot be sent ({type(error).__name__})") from error
        spawns = tuple(vector(spawn, f"spawns[{i}]") for i, spawn in enumerate(items(self.spawns, "spawns")))
        if not spawns:
            raise SceneError(f"spawns = {shown(self.spawns)}: must list at least one position")
        for i, spawn in enumerate(spawns):
            for axis, value in zip("xyz", spawn, strict=True):
                to_position(value, f"spawns[{i}].{axis}")
        object.__setattr__(self, "spawns", spawns)
        for i, template in enumerate(items(self.templates, "templates")):
            if not isinstance(template, Template):
                raise SceneError(f"templates[{i}] = {shown(template)}: must be a `Template`")
        if not 1 <= len(self.templates) <= TEMPLATES_MAX:
            raise SceneError(f"templates: {len(self.templates)} of them; must be 1 to {TEMPLATES_MAX}")
        object.__setattr__(self, "templates", tuple(self.templates))
        names = [template.name for template in self.templates]
        if len(set(names)) < len(names):
            raise SceneError(f"templates: two have the same name ({', '.join(names)})")
        self.template(self.player, "player")

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> "Scene":
        """A scene from what TOML or the wire gives.

        Raises:
            SceneError: a field is unknown, missing or out of range; the message names it.
        """
        given: object = table
        if not isinstance(given, Mapping):
            raise SceneError(f"scene = {shown(given)}: must be a table")
        known = {f.name for f in fields(cls)}
        for key in table:
            if key not in known:
                raise SceneError(f"{key}: no such field (there are {', '.join(sorted(known))})")
        if "name" not in table:
            raise SceneError("name: missing")
        values = dict(table)
        if "templates" in values:
            values["templates"] = tuple(_template(entry) for entry in items(values["templates"], "templates"))
        if "spawns" in values:
            values["spawns"] = tuple(items(values["spawns"], "spawns"))
        return cls(**values)

    def to_table(self) -> dict[str, Any]:
        """The reverse of `from_table`: plain lists, tables, strings and numbers."""
        table = {f.name: _plain(getattr(self, f.name)) for f in fields(self)}
        table["templates"] = [
            {f.name: _plain(getattr(entry, f.name)) for f in fields(entry)} for entry in self.templates
        ]
        return table

    @functools.cached_property
    def fingerprint(self) -> bytes:
        """16 bytes: two sides with the same one compute the same world."""
        return hashlib.blake2b(msgpack.packb(_sorted(self.to_table())), digest_size=16).digest()

    @functools.cached_property
    def index_of(self) -> dict[str, int]:
        """Template names to their numbers."""
        return {template.name: i for i, template in enumerate(self.templates)}

    def template(self, name: object, at: str = "template") -> int:
        """The number of a template.

        Args:
            name: the template's.
            at: where the name stands, for the error.

        Raises:
            SceneError: there is no such template.
        """
        kind = self.index_of.get(name) if isinstance(name, str) else None
        if kind is None:
            raise SceneError(f"{at} = {shown(name)}: no such template (there are {', '.join(self.index_of)})")
        return kind

    def with_template(self, name: str, like: str | None = None, **changes: Any) -> "Scene":
        """The same scene with one template more.

        Args:
            like: the template to begin with; None: that of players.
            changes: what is different, by the field's name.

        Raises:
            SceneError: there is no template to begin with, a field is unknown or out of range, or the name is taken.
        """
        base = self.templates[self.template(self.player if like is None else like, "like")]
        entry = {f.name: getattr(base, f.name) for f in fields(Template)}
        return replace(self, templates=(*self.templates, _template({**entry, **changes, "name": name})))

    def segments(self) -> list[Cell]:
        """The index of every segment of the world, in ascending order of z, y, x."""
        (ox, oy, oz), (nx, ny, nz) = self.origin, self.size
        return [(ox + x, oy + y, oz + z) for z in range(nz) for y in range(ny) for x in range(nx)]

    @functools.cached_property
    def digests(self) -> dict[str, bytes]:
        """8 bytes for each field, so that two sides can tell by name where they differ."""
        return {
            name: hashlib.blake2b(msgpack.packb(_sorted(value)), digest_size=8).digest()
            for name, value in self.to_table().items()
        }

    def kernel_tables(self) -> tuple[layout.Int64s, layout.Int64s, layout.Int64s]:
        """Templates, walk velocities and parameters as `layout.Arrays` wants them, each rounded once."""
        templates = np.array([template.row() for template in self.templates], np.int64)
        walk = np.array(
            [
                [rounded(t.walk_speed * SPEED * move / MOVE_MAX) for move in range(-MOVE_MAX, MOVE_MAX + 1)]
                for t in self.templates
            ],
            np.int64,
        )
        p = np.zeros(layout.PARAMETERS, np.int64)
        p[layout.GRAVITY] = rounded(self.gravity * SPEED / self.tick_rate)
        p[layout.TERMINAL] = to_velocity(self.terminal_speed, "terminal_speed")
        p[layout.RATE] = self.tick_rate
        p[layout.EXACT] = 128 // self.tick_rate if 128 % self.tick_rate == 0 else 0
        p[layout.MEAN] = self.integrator == "mean"
        p[layout.PAIRS] = self.entity_collision
        p[layout.FLOOR] = self.origin[2] * SEGMENT
        low, high = templates[:, :3], templates[:, :3] + templates[:, 3:6]
        p[layout.REACH_LO : layout.REACH_LO + 3] = (-low).max(axis=0)
        p[layout.REACH_HI : layout.REACH_HI + 3] = high.max(axis=0)
        return templates, walk, p


def load_scene(name_or_path: str | Path) -> Scene:
    """A scene that comes with the package, by name, or any other by the path of its TOML file.

    Raises:
        SceneError: there is no such scene, or its file is broken; the message says where.
    """
    if not isinstance(name_or_path, str | Path):
        raise SceneError(f"scene = {shown(name_or_path)}: must be a name, or the path of a file")
    built_in, path = SCENES / f"{name_or_path}.toml", Path(name_or_path)
    try:
        path = built_in if built_in.is_file() else path
        table = tomllib.loads(path.read_text("utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"scene {path}: not valid TOML ({error})") from error
    except (OSError, ValueError) as error:  # no such file; or its text, or its path, is none
        names = ", ".join(sorted(file.stem for file in SCENES.glob("*.toml")))
        raise SceneError(f"scene {name_or_path!r}: cannot be read ({error}); built in are {names}") from error
    try:
        return Scene.from_table({"name": path.stem} | table)
    except SceneError as error:
        raise SceneError(f"scene {path}: {error}") from error


def _template(entry: object) -> Template:
    if not isinstance(entry, Mapping):
        raise SceneError(f"templates: {entry!r} must be a table")
    known = {f.name for f in fields(Template)}
    for key in entry:
        if key not in known:
            raise SceneError(f"templates.{key}: no such field (there are {', '.join(sorted(known))})")
    if "name" not in entry:
        raise SceneError("templates.name: missing")
    return Template(**entry)


def _plain(value: Any) -> Any:
    """Lists for tuples, tables for mappings, all the way down."""
    if isinstance(value, Mapping):
        return {key: _plain(value[key]) for key in value}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value


def _sorted(value: Any) -> Any:
    """Tables with their keys in order, and whole floats as floats: 18 and 18.0 are one number."""
    if isinstance(value, Mapping):
        return {key: _sorted(value[key]) for key in sorted(value)}
    if isinstance(value, list):
        return [_sorted(part) for part in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value
