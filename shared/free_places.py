"""Free places: whether a template's box is free at a position, and the nearest free position to one that is occupied.

A place is occupied if a block or a solid entity overlaps the box there. Boxes that only touch do not overlap.
"""

from collections.abc import Iterable, Iterator

from shared import layout
from shared.checks import SceneError, vector
from shared.layout import ID
from shared.units import BLOCK, to_position
from shared.world_state import WorldState

PUSHES = ((2, 1), (0, -1), (0, 1), (1, -1), (1, 1), (2, -1))
"""Directions in which an overlapping box may be pushed, as axis and sign, by preference at equal distance."""


class OverlapError(SceneError):
    """The place is occupied by a block or by a solid entity."""


def box_at(world: WorldState, kind: int, position: Iterable[int]) -> list[int]:
    """Returns the low and the high corner of a template's box at a position, in grid steps."""
    x, y, z = position
    low_x, low_y, low_z, size_x, size_y, size_z = world.boxes[kind]
    x, y, z = x + low_x, y + low_y, z + low_z
    return [x, y, z, x + size_x, y + size_y, z + size_z]


def _near(world: WorldState, but: int, box: list[int]) -> layout.Int64s:
    """Returns the kernel's candidates for a box, [n, 7], without the row `but` (-1: none is left out)."""
    end = world.kernel.gather(world.bound, but, True, *box)
    return world.candidates[: end // layout.CANDIDATE]


def overlapping(world: WorldState, but: int, box: list[int]) -> list[int]:
    """Returns the ids of the solid entities that overlap a box, ascending, without the row `but` (-1: none)."""
    return sorted(int(world.entity_rows[row, ID]) for row in _overlaps(world, but, box))


def _overlaps(world: WorldState, but: int, box: list[int]) -> Iterator[int]:
    """Yields the rows of the solid entities that overlap a box, without the row `but` (-1: none)."""
    x0, y0, z0, x1, y1, z1 = box
    end = world.kernel.gather(world.bound, but, True, *box)
    found = iter(world.candidates_flat[:end].tolist())
    for low_x, low_y, low_z, high_x, high_y, high_z, row in zip(*[found] * layout.CANDIDATE, strict=True):
        if low_x < x1 and low_y < y1 and low_z < z1 and high_x > x0 and high_y > y0 and high_z > z0:
            yield row


def taken(world: WorldState, row: int, kind: int, box: list[int]) -> bool:
    """Returns whether a block or a solid entity is in the way of a template's box, without the row `row` (-1: none)."""
    if world.kernel.blocks_in(world.bound, *box):
        return True
    return world.meets[kind] and next(_overlaps(world, row, box), None) is not None


def free_place(world: WorldState, row: int, kind: int, position: object, push: bool) -> list[int]:
    """Returns a free position for an entity, in grid steps: the given one, or with `push` the nearest free one.

    Args:
        world: the world.
        row: row of the entity, which is not in its own way; -1 for a new entity.
        kind: number of the entity's template.
        position: in blocks, rounded to the grid.
        push: use the nearest free position, at most a block away along one axis, if the given one is occupied.

    Raises:
        OverlapError: the place is occupied (and, with `push`, so are the places near it).
        SceneError: a value is not finite or out of range.
    """
    parts = x, y, z = vector(position, "position")
    at = [to_position(x, "position.x"), to_position(y, "position.y"), to_position(z, "position.z")]
    if not taken(world, row, kind, box_at(world, kind, at)):
        return at
    places = (_pushed(world, row, kind, at, axis, sign) for axis, sign in PUSHES) if push else ()
    if pushed := [moved for moved in places if moved is not None]:
        return min(pushed, key=lambda moved: sum(abs(a - b) for a, b in zip(moved, at, strict=True)))
    near = " nor within a block of it" if push else ""
    raise OverlapError(f"position = {parts}: no room for a {world.scene.templates[kind].name!r} there{near}")


def _pushed(world: WorldState, row: int, kind: int, at: list[int], axis: int, sign: int) -> list[int] | None:
    """Returns the nearest free position in one direction, at most a block away; None if there is none."""
    start = box_at(world, kind, at)
    stops = _stops(world, row, kind, start, axis, sign)
    for stop in stops:
        distance = (stop - start[axis]) if sign > 0 else (start[axis + 3] - stop)
        if not 0 < distance <= BLOCK:
            continue
        moved = list(at)
        moved[axis] += sign * distance
        if not taken(world, row, kind, box_at(world, kind, moved)):
            return moved
    return None


def _stops(world: WorldState, row: int, kind: int, box: list[int], axis: int, sign: int) -> list[int]:
    """Returns the faces within a block that could stop a pushed box, nearest first, in grid steps."""
    face = box[axis] if sign > 0 else box[axis + 3]
    first = -(-face // BLOCK) if sign > 0 else face // BLOCK
    faces = [first * BLOCK, (first + sign) * BLOCK]
    if world.meets[kind]:
        reach = list(box)
        reach[axis + 3 if sign > 0 else axis] += sign * BLOCK
        near = _near(world, row, reach)
        faces += near[:, axis + 3 if sign > 0 else axis].tolist()
    return sorted(set(faces), reverse=sign < 0)
