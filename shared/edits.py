"""Edits: blocks that players place and remove, by one rule on both sides, so that a client can predict them."""

from typing import TYPE_CHECKING, NamedTuple

import msgpack

from shared.blocks import AIR, KIND_MAX
from shared.checks import SceneError, is_whole, shown, whole
from shared.free_places import OverlapError, overlapping
from shared.layout import X
from shared.messages import DONE, INVALID, OUT_OF_REACH, OVERLAPS
from shared.units import BLOCK
from shared.world_state import WorldState

if TYPE_CHECKING:
    from shared.world import World

NAME = "edit"
"""Name of the command that carries an edit."""


class Edit(NamedTuple):
    """A change of one block: (x, y, z) becomes `kind`; 0 removes it."""

    x: int
    y: int
    z: int
    kind: int


class EditError(SceneError, OverflowError):
    """An edit whose place or kind is out of range."""


FAR = (1 << 28) - 1
"""Greatest distance of a block from 0 along each axis, in blocks."""


def checked(x: object, y: object, z: object, kind: object) -> Edit:
    """Returns an edit of checked numbers.

    Raises:
        EditError: a value is out of range.
        TypeError: a value is not a whole number.
    """
    for value, at in ((x, "x"), (y, "y"), (z, "z"), (kind, "kind")):
        if not is_whole(value):
            raise TypeError(f"{at} = {shown(value)}: must be a whole number")
    try:
        at_x, at_y, at_z = (whole(value, at, -FAR, FAR) for value, at in ((x, "x"), (y, "y"), (z, "z")))
        return Edit(at_x, at_y, at_z, whole(kind, "kind", AIR, KIND_MAX))
    except SceneError as error:
        raise EditError(str(error)) from None


def pack(edit: Edit) -> bytes:
    """Returns the payload of the command that carries an edit."""
    return msgpack.packb(tuple(edit))  # type: ignore[no-any-return]


def unpack(payload: bytes) -> Edit | None:
    """Returns the edit in a payload that `pack` made; None for any other bytes."""
    try:
        parts = msgpack.unpackb(payload, max_array_len=4)
    except Exception:  # msgpack raises about ten types of exceptions for such bytes
        return None
    if type(parts) is not list or len(parts) != 4 or any(type(part) is not int for part in parts):
        return None
    edit = Edit(*parts)
    return edit if all(abs(part) <= FAR for part in edit[:3]) and AIR <= edit.kind <= KIND_MAX else None


def verdict(world: WorldState, entity: int, edit: Edit) -> int:
    """Returns the verdict on an edit by an entity, without carrying it out: as `apply`."""
    if not _in_reach(world, entity, edit):
        return OUT_OF_REACH if entity in world else INVALID
    x, y, z, kind = edit
    if world.blocks.get(x, y, z) is None:
        return INVALID
    low = [part * BLOCK for part in edit[:3]]
    in_the_way = world.blocks.stops[kind] and overlapping(world, -1, low + [part + BLOCK for part in low])
    return OVERLAPS if in_the_way else DONE


def _in_reach(world: WorldState, entity: int, edit: Edit) -> bool:
    """Returns whether an entity exists and its position is within `Scene.reach` of the centre of an edit's block."""
    if entity not in world:
        return False
    centre = [part * BLOCK + BLOCK // 2 for part in edit[:3]]
    way = [a - b for a, b in zip(centre, world.state(entity)[X : X + 3], strict=True)]
    return sum(part * part for part in way) <= (world.scene.reach * BLOCK) ** 2


def apply(world: "World", entity: int, edit: Edit) -> int:
    """Carries out an edit by the player with the entity `entity`, if the rules allow it.

    Returns:
        The verdict, as in `shared.messages`: DONE, OUT_OF_REACH (beyond `Scene.reach`), OVERLAPS (an entity is in the
        way) or INVALID (there is no such entity, or the segment is not loaded).
    """
    if not _in_reach(world, entity, edit):
        return OUT_OF_REACH if entity in world else INVALID
    try:
        world.set_block(*edit)
    except OverlapError:
        return OVERLAPS
    except SceneError:
        return INVALID
    return DONE
