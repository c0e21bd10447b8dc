"""Placing and removing blocks as a player: one rule for both sides, so that an edit can be predicted."""

from typing import NamedTuple

import msgpack

from shared.blocks import AIR, KIND_MAX
from shared.checks import WHOLE, SceneError, shown, whole
from shared.layout import X
from shared.messages import DONE, INVALID, OUT_OF_REACH, OVERLAPS
from shared.units import BLOCK
from shared.world import OverlapError, World

NAME = "edit"
"""The name of the command."""


class Edit(NamedTuple):
    """Block (x, y, z) becomes `kind`; 0 removes it."""

    x: int
    y: int
    z: int
    kind: int


class EditError(SceneError, OverflowError):
    """An edit of a block beyond all worlds, or to a kind that there is not."""


FAR = (1 << 28) - 1
"""No block is further from 0 along an axis."""


def checked(x: object, y: object, z: object, kind: object) -> Edit:
    """An edit of whole numbers.

    Raises:
        EditError: one of them is out of range.
        TypeError: one of them is none.
    """
    for value, at in ((x, "x"), (y, "y"), (z, "z"), (kind, "kind")):
        if isinstance(value, bool) or not isinstance(value, WHOLE):
            raise TypeError(f"{at} = {shown(value)}: must be a whole number")
    try:
        at_x, at_y, at_z = (whole(value, at, -FAR, FAR) for value, at in ((x, "x"), (y, "y"), (z, "z")))
        return Edit(at_x, at_y, at_z, whole(kind, "kind", AIR, KIND_MAX))
    except SceneError as error:
        raise EditError(str(error)) from None


def pack(edit: Edit) -> bytes:
    """The payload of the command."""
    return msgpack.packb(tuple(edit))  # type: ignore[no-any-return]


def unpack(payload: bytes) -> Edit | None:
    """The reverse of `pack`; None for any other bytes."""
    try:
        parts = msgpack.unpackb(payload, max_array_len=4)
    except Exception:  # msgpack raises some ten kinds for bytes that are not MessagePack
        return None
    if type(parts) is not list or len(parts) != 4 or any(type(part) is not int for part in parts):
        return None
    edit = Edit(*parts)
    return edit if all(abs(part) <= FAR for part in edit[:3]) and AIR <= edit.kind <= KIND_MAX else None


def apply(world: World, entity: int, edit: Edit) -> int:
    """Carries out an edit of `entity` if the rules allow it; the verdict (`DONE`, ...)."""
    if entity not in world:
        return INVALID
    centre = [part * BLOCK + BLOCK // 2 for part in edit[:3]]
    way = [a - b for a, b in zip(centre, world.state(entity)[X : X + 3], strict=True)]
    if sum(part * part for part in way) > (world.scene.reach * BLOCK) ** 2:
        return OUT_OF_REACH
    try:
        world.set_block(*edit)
    except OverlapError:
        return OVERLAPS
    except SceneError:
        return INVALID
    return DONE
