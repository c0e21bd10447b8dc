"""The scene: the description of a world, with all numbers of its physics.

Every value is checked when a scene is made. A fingerprint shows whether client and server have the same scene.
"""

import functools
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import msgpack

from shared import behaviours as behaviour_classes
from shared import layout
from shared.aim import NO_AIM, Aim
from shared.arrays import np
from shared.behaviours import BehaviourEntry, checked_entries
from shared.block_kind import BlockKind, numbered, numbered_fill
from shared.bounds import TICK_RATE_MAX
from shared.buttons import DEFAULT_BUTTONS, Names, bits_of, checked_buttons, held_names
from shared.checks import Cell, SceneError, Vec, boolean, cell, choice, finite, items, shown, text, vector, whole
from shared.extras import Extras
from shared.fields import AIM_ROW_BYTES, INPUT_ROW_BYTES
from shared.inputs import MOVE_MAX
from shared.scene_copies import SceneCopies
from shared.tables import in_order, made, plain, table_of
from shared.template import Template, own_numbers
from shared.units import RANGE_BLOCKS, SEGMENT, SPEED, rounded, to_position, to_velocity

__all__ = ["INTEGRATORS", "SCENES", "BlockKind", "Scene", "Template", "load_scene"]

TEMPLATES_MAX = 255
"""Limit of the templates of a scene."""
SEGMENTS_MAX = 1 << 16
"""Limit of the segments of a scene."""
REACH_MAX = 1024.0
"""Greatest reach of a player, in blocks."""
INTEGRATORS = ("mean", "semi")
"""Choices of `Scene.integrator`."""
CHANCE_MAX = (1 << 63) - 1
"""Greatest seed of `Scene.chance`."""

OPTIONAL = frozenset({"aim", "behaviours", "buttons", "carries", "chance", "kinds"})
"""Fields of scenes and templates that a table leaves out if they have their default, so that scenes without them keep
their bytes and their fingerprint. A field that is None is left out, too."""

SCENES = Path(__file__).parent / "scenes"
"""Folder of the scenes that come with the package."""


@dataclass(frozen=True)
class Scene(SceneCopies):
    """The description of a world: its physics, its extent, its templates and its terrain.

    A feature that a scene switches off costs no time.

    Args:
        name: name of the scene.
        templates: the templates of entities.
        tick_rate: ticks per second, 1 to 240.
        gravity: downward acceleration in blocks/s^2; 0: there is no gravity, no support and no jumping.
        terminal_speed: greatest speed of a fall, in blocks/s.
        integrator: "mean" moves an entity by the mean of the old and the new fall speed, which is exact for a constant
            acceleration; "semi" moves it by the new one (the rule of the project's first proposal).
        entity_collision: whether solid entities stop each other.
        size: extent of the world in segments of 32 blocks, along x, y and z.
        origin: index of the segment with the lowest x, y and z.
        terrain: name of the terrain generator under "generator", and its parameters.
        spawns: spawn points, which players use in turn, in blocks.
        player: name of the players' template.
        reach: greatest distance from a player's position to the centre of a block that it may place or remove, in
            blocks; 0: players cannot edit.
        buttons: names of the players' buttons, at most 8; "jump" is bit 0, which the physics reads, and the others
            have the bits after it in this order.
        aim: whether players send an aim, a direction in space, with each input. It costs 6 bytes per input.
        kinds: the kinds of blocks that have a name, for rules and pictures, and which of them are not solid. Kinds
            without an entry are solid. The last item of an entry of the terrain's `fill` may be such a name.
        behaviours: the behaviours of templates (`shared.behaviours`); `with_behaviours` adds them.
        chance: seed of `Body.chance`, 0 to 2^63 - 1.

    Raises:
        SceneError: a value is not valid; the message names it.
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
    buttons: tuple[str, ...] = DEFAULT_BUTTONS
    aim: bool = False
    kinds: tuple[BlockKind, ...] = ()
    behaviours: tuple[BehaviourEntry, ...] = ()
    chance: int = 0

    def __repr__(self) -> str:
        """Returns a short text, because events are printed with it; `to_table` has all values."""
        blocks = " x ".join(str(SEGMENT * part) for part in self.size)
        return f"<Scene {self.name!r}, {blocks} blocks, {self.tick_rate} ticks/s>"

    def __post_init__(self) -> None:
        own_numbers(self)
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
        boolean(self.aim, "aim")
        object.__setattr__(self, "buttons", checked_buttons(self.buttons))
        if not 0 <= finite(self.reach, "reach") <= REACH_MAX:
            raise SceneError(f"reach = {self.reach!r}: must be 0 to {REACH_MAX:g}")
        object.__setattr__(self, "size", cell(self.size, "size", 1, SEGMENTS_MAX))
        limit = RANGE_BLOCKS // SEGMENT
        object.__setattr__(self, "origin", cell(self.origin, "origin", -limit, limit - 1))
        if max(low + side for low, side in zip(self.origin, self.size, strict=True)) > limit:
            raise SceneError(f"origin = {self.origin}, size = {self.size}: reaches further than {RANGE_BLOCKS} blocks")
        if self.size[0] * self.size[1] * self.size[2] > SEGMENTS_MAX:
            raise SceneError(f"size = {self.size}: more than {SEGMENTS_MAX} segments")
        object.__setattr__(self, "kinds", numbered(items(self.kinds, "kinds")))
        terrain: object = self.terrain
        if not isinstance(terrain, Mapping) or not isinstance(terrain.get("generator"), str):
            raise SceneError(f"terrain = {shown(terrain)}: must be a table with a generator")
        for key, value in terrain.items():
            text(key, "terrain: the name of a parameter")
            try:
                msgpack.packb(plain(value))
            except (TypeError, ValueError, OverflowError, RecursionError) as error:
                raise SceneError(f"terrain.{key} = {shown(value)}: cannot be sent ({type(error).__name__})") from error
        fill = terrain.get("fill")
        if self.kinds and isinstance(fill, list | tuple):
            object.__setattr__(self, "terrain", {**terrain, "fill": numbered_fill(fill, self.kind)})
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
        for template in self.templates:
            weight = template.rates(self.gravity, self.tick_rate)[0]
            if weight > 0 and to_velocity(self.terminal_speed, "terminal_speed") == 0:
                at = f"templates.{template.name}.gravity = {template.gravity!r}"
                raise SceneError(f"{at}: terminal_speed = {self.terminal_speed!r} lets nothing fall")
        whole(self.chance, "chance", 0, CHANCE_MAX)
        object.__setattr__(self, "behaviours", checked_entries(self.behaviours))
        self.extras  # noqa: B018 - checks the behaviours' templates

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> "Scene":
        """Returns the scene that a table from TOML or from a welcome describes.

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
            entries = items(values["templates"], "templates")
            values["templates"] = tuple(made(Template, entry, "templates") for entry in entries)
        if "kinds" in values:
            values["kinds"] = tuple(made(BlockKind, entry, "kinds") for entry in items(values["kinds"], "kinds"))
        if "spawns" in values:
            values["spawns"] = tuple(items(values["spawns"], "spawns"))
        return cls(**values)

    def to_table(self) -> dict[str, Any]:
        """Returns a table for `from_table`, of plain lists, tables, texts and numbers."""
        table = table_of(self, OPTIONAL) | {"templates": [table_of(entry, OPTIONAL) for entry in self.templates]}
        return table | ({"kinds": [table_of(entry, OPTIONAL) for entry in self.kinds]} if self.kinds else {})

    @functools.cached_property
    def fingerprint(self) -> bytes:
        """A hash of all fields, 16 bytes; two sides with equal fingerprints compute the same world."""
        return hashlib.blake2b(msgpack.packb(in_order(self.to_table())), digest_size=16).digest()

    @functools.cached_property
    def button_bits(self) -> dict[str, int]:
        """The bits of the buttons in `Input.buttons`, by name."""
        return bits_of(self.buttons)

    def button(self, name: object) -> int:
        """Returns the bit of a button in `Input.buttons`.

        Raises:
            SceneError: the scene has no such button.
        """
        bit = self.button_bits.get(name) if isinstance(name, str) else None
        if bit is None:
            known = ", ".join(self.buttons)
            raise SceneError(f"button = {shown(name)}: no such button (there are {known or 'none'})")
        return bit

    def buttons_bits(self, names: Names) -> int:
        """Returns the bits of several buttons, for `make_input(buttons=...)`.

        Args:
            names: one name, several, or a table of names with whether each is held.

        Raises:
            SceneError: the scene has no such button.
        """
        return functools.reduce(lambda bits, name: bits | self.button(name), held_names(names), 0)

    def check_aim(self, aim: Aim, at: str = "aim") -> None:
        """Checks that an input for this scene may have an aim.

        Raises:
            SceneError: it has one, and the scene has no aim.
        """
        if aim != NO_AIM and not self.aim:
            raise SceneError(f"{at} = {shown(aim)}: the scene {self.name!r} has no aim (`Scene.aim`)")

    @property
    def input_row_bytes(self) -> int:
        """Length of one input in a message, in bytes."""
        return AIM_ROW_BYTES if self.aim else INPUT_ROW_BYTES

    @functools.cached_property
    def index_of(self) -> dict[str, int]:
        """The numbers of the templates, by name."""
        return {template.name: i for i, template in enumerate(self.templates)}

    def template(self, name: object, at: str = "template") -> int:
        """Returns the number of a template.

        Args:
            name: name of the template.
            at: name of the field or argument that has `name`, for the error.

        Raises:
            SceneError: there is no such template.
        """
        kind = self.index_of.get(name) if isinstance(name, str) else None
        if kind is None:
            raise SceneError(f"{at} = {shown(name)}: no such template (there are {', '.join(self.index_of)})")
        return kind

    def kind(self, name: object, at: str = "kind") -> int:
        """Returns the number of a named kind of blocks.

        Args:
            name: name of the kind.
            at: name of the field or argument that has `name`, for the error.

        Raises:
            SceneError: there is no such kind.
        """
        for kind in self.kinds:
            if kind.name == name and kind.number is not None:
                return kind.number
        raise SceneError(
            f"{at} = {shown(name)}: no such kind (there are {', '.join(each.name for each in self.kinds)})"
        )

    @functools.cached_property
    def passable(self) -> tuple[int, ...]:
        """The numbers of the kinds of blocks that are not solid, besides air."""
        return tuple(kind.number for kind in self.kinds if not kind.solid and kind.number is not None)

    def bound(self, classes: Iterable[object]) -> "Scene":
        """Returns a copy of the scene that has this program's classes of its behaviours.

        Raises:
            SceneError: a class is missing, or differs from the one that the scene names.
        """
        return replace(self, behaviours=behaviour_classes.bound(self.behaviours, classes)) if self.behaviours else self

    @functools.cached_property
    def extras(self) -> Extras:
        """The extra columns of the states of entities."""
        return Extras(self)

    def segments(self) -> list[Cell]:
        """Returns the index of every segment of the scene, in ascending order of z, y, x."""
        (ox, oy, oz), (nx, ny, nz) = self.origin, self.size
        return [(ox + x, oy + y, oz + z) for z in range(nz) for y in range(ny) for x in range(nx)]

    @functools.cached_property
    def digests(self) -> dict[str, bytes]:
        """A hash of each field, 8 bytes, by name; two sides find the fields that differ by these."""
        return {
            name: hashlib.blake2b(msgpack.packb(in_order(value)), digest_size=8).digest()
            for name, value in self.to_table().items()
        }

    def kernel_tables(self) -> tuple[layout.Int64s, layout.Int64s, layout.Int64s]:
        """Returns templates, walk velocities and parameters for `layout.Arrays`; each number is rounded once."""
        rows = [[*t.row(), *t.rates(self.gravity, self.tick_rate), t.carries] for t in self.templates]
        walk = [_walk_velocities(template.walk_speed) for template in self.templates]
        p = [0] * layout.PARAMETERS
        p[layout.GRAVITY] = any(row[layout.WEIGHT] > 0 for row in rows)
        p[layout.TERMINAL] = to_velocity(self.terminal_speed, "terminal_speed")
        p[layout.RATE] = self.tick_rate
        p[layout.EXACT] = 128 // self.tick_rate if 128 % self.tick_rate == 0 else 0
        p[layout.MEAN] = self.integrator == "mean"
        p[layout.PAIRS] = self.entity_collision
        p[layout.FLOOR] = self.origin[2] * SEGMENT
        for axis in range(3):
            p[layout.REACH_LO + axis] = max(-row[layout.LO_X + axis] for row in rows)
            p[layout.REACH_HI + axis] = max(row[layout.LO_X + axis] + row[layout.SIZE_X + axis] for row in rows)
        return np.array(rows, np.int64), np.array(walk, np.int64), np.array(p, np.int64)


def load_scene(name_or_path: str | Path) -> Scene:
    """Loads a scene of the package by its name, or any other one by the path of its TOML file.

    Raises:
        SceneError: there is no such scene, or its file is not valid; the message says where.
    """
    if not isinstance(name_or_path, str | Path):
        raise SceneError(f"scene = {shown(name_or_path)}: must be a name, or the path of a file")
    import tomllib  # here, because a client gets its scene from a server

    built_in, path = SCENES / f"{name_or_path}.toml", Path(name_or_path)
    try:
        path = built_in if built_in.is_file() else path
        table = tomllib.loads(path.read_text("utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"scene {path}: not valid TOML ({error})") from error
    except (OSError, ValueError) as error:  # no such file, or the text or the path is not valid
        names = ", ".join(sorted(file.stem for file in SCENES.glob("*.toml")))
        raise SceneError(f"scene {name_or_path!r}: cannot be read ({error}); built in are {names}") from error
    try:
        return Scene.from_table({"name": path.stem} | table)
    except SceneError as error:
        raise SceneError(f"scene {path}: {error}") from error


@functools.lru_cache(maxsize=TEMPLATES_MAX)
def _walk_velocities(walk_speed: float) -> tuple[int, ...]:
    """Returns the velocity for each value of a part of an input, for `layout.Arrays.walk`."""
    return tuple(rounded(walk_speed * SPEED * move / MOVE_MAX) for move in range(-MOVE_MAX, MOVE_MAX + 1))
