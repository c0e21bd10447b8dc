"""The templates of a scene: named sets of properties that entities share, and their rows for the kernel."""

from dataclasses import dataclass, fields
from typing import Any

from shared.checks import SceneError, Vec, boolean, choice, finite, own_number, text, vector
from shared.units import to_position, to_velocity

BOX_MAX = 32.0
"""Longest side, and longest offset, of a template's box, in blocks."""
SHOWN = ("interpolated", "predicted")
"""Choices of `Template.shown`."""
AT_ONCE = 1 << 31
"""Change of a velocity in one tick that reaches any other velocity, in velocity steps per tick."""


def own_numbers(owner: Any) -> None:
    """Replaces numpy's numbers in the fields of a dataclass by Python's own, because MessagePack holds no others."""
    for f in fields(owner):
        value = getattr(owner, f.name)
        if (own := own_number(value)) is not value:
            object.__setattr__(owner, f.name, own)


@dataclass(frozen=True)
class Template:
    """A named set of properties that entities share. Lengths in blocks, speeds in blocks/s.

    Args:
        name: name of the template.
        box_offset: displacement of the box's corner from the entity's position.
        box_size: sides of the box; a negative side extends the box to the other direction, as the project's first
            proposal did for y.
        walk_speed: speed with which an entity follows its input; 0: it ignores inputs and keeps its velocity.
        jump_speed: upward speed of a jump; 0: an entity cannot jump.
        solid: whether entities of this template and other solid ones stop each other, and stand on each other. Blocks
            stop every entity.
        shown: how clients draw such entities, apart from their own: "interpolated" (a little in the past) or
            "predicted" (now, if their inputs do not change).
        gravity: downward acceleration in blocks/s^2; 0: the entity floats, without support and jumps; None: the
            scene's.
        acceleration: greatest change of the horizontal velocity towards the one that the input asks for, in blocks/s^2;
            None: an entity that walks follows its input at once.
        friction: deceleration without an input, and of a speed above `walk_speed`, in blocks/s^2. It acts on entities
            that do not walk, too, and where there is no gravity on the vertical velocity. None: the acceleration for
            entities that walk, and no friction for the others.
        air_control: share of acceleration and friction while the entity falls, 0 to 1; None: 1 for entities that walk,
            and 0 for the others.
        carries: whether an entity that stands on one of this template, and those on top of it, move along with it. A
            template that carries has to be solid.

    Raises:
        SceneError: a value is not valid; the message names it.
    """

    name: str
    box_offset: Vec = (-0.3, -0.3, 0.0)
    box_size: Vec = (0.6, 0.6, 1.8)
    walk_speed: float = 0.0
    jump_speed: float = 0.0
    solid: bool = True
    shown: str = "interpolated"
    gravity: float | None = None
    acceleration: float | None = None
    friction: float | None = None
    air_control: float | None = None
    carries: bool = False

    def __post_init__(self) -> None:
        own_numbers(self)
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
        if boolean(self.carries, f"{at}.carries") and not self.solid:
            raise SceneError(f"{at}.carries = True: needs solid = True")
        choice(self.shown, f"{at}.shown", SHOWN)
        for name in ("gravity", "acceleration", "friction", "air_control"):
            value = getattr(self, name)
            if value is not None and finite(value, f"{at}.{name}") < 0:
                raise SceneError(f"{at}.{name} = {value!r}: must not be negative")
        if self.acceleration == 0:
            raise SceneError(
                f"{at}.acceleration = {self.acceleration!r}: nothing could walk; set walk_speed = 0 instead"
            )
        if self.air_control is not None:
            if self.air_control > 1:
                raise SceneError(f"{at}.air_control = {self.air_control!r}: must be 0 to 1")
            if self.acceleration is None and (self.friction is None or self.walk_speed > 0):
                raise SceneError(f"{at}.air_control = {self.air_control!r}: needs an acceleration")
        object.__setattr__(self, "box_offset", offset)
        object.__setattr__(self, "box_size", size)

    def row(self) -> list[int]:
        """Returns the columns of `layout.Arrays.templates` before `layout.WEIGHT`.

        The box gets its low corner and positive sides.
        """
        low, sides = [], []
        for axis, offset, size in zip("xyz", self.box_offset, self.box_size, strict=True):
            ends = sorted((to_position(offset, axis), to_position(offset, axis) + to_position(size, axis)))
            low.append(ends[0])
            sides.append(ends[1] - ends[0])
        return [*low, *sides, self.solid, self.walk_speed > 0, to_velocity(self.jump_speed, "jump_speed")]

    def rates(self, gravity: float, tick_rate: int) -> list[int]:
        """Returns the columns of `layout.Arrays.templates` from `layout.WEIGHT` up to `layout.CARRIES` (excluded).

        Args:
            gravity: gravity of the scene, in blocks/s^2.
            tick_rate: ticks per second.

        Raises:
            SceneError: a value vanishes in one tick, or is too large.
        """

        def per_tick(name: str, value: float) -> int:
            at = f"templates.{self.name}.{name}"
            steps = to_velocity(value / tick_rate, at)
            if steps == 0 and value > 0:
                raise SceneError(f"{at}: {value!r} blocks/s^2 vanish in one tick; 0 switches it off")
            return steps

        weight = gravity if self.gravity is None else self.gravity
        walks = self.walk_speed > 0
        accelerates = walks and self.acceleration is not None
        if self.friction is None and not accelerates:
            return [per_tick("gravity", weight), *[0] * 7]
        share = float(walks) if self.air_control is None else self.air_control
        changes = []
        for part in (1.0, share if weight > 0 else 1.0):
            faster = AT_ONCE if self.acceleration is None else per_tick("acceleration", self.acceleration * part)
            slower = faster if self.friction is None else per_tick("friction", self.friction * part)
            changes += [faster, slower, slower or faster]
        top = to_velocity(self.walk_speed, "walk_speed") + 2  # the parts of a direction are rounded
        return [per_tick("gravity", weight), top * top, *changes]
