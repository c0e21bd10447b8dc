"""Placing and removing blocks as a player: one rule for both sides, so that an edit can be predicted."""

from typing import NamedTuple

import msgpack

from shared.checks import SceneError
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
    return edit if all(abs(part) < 1 << 28 for part in edit[:3]) and 0 <= edit.kind <= 255 else None


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
