"""The kinds of blocks of a scene that have a name: water, ladder, grass."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from shared.blocks import KIND_MAX
from shared.checks import SceneError, boolean, shown, text, whole
from shared.template import own_numbers


@dataclass(frozen=True)
class BlockKind:
    """A named kind of blocks.

    Args:
        name: name of the kind.
        number: number of the kind in the blocks of the world, 1 to 255; None: the number after that of the kind before
            it in the scene, from 1.
        solid: whether such blocks stop and support entities. Entities and rays pass through the others.

    Raises:
        SceneError: a value is not valid; the message names it.
    """

    name: str
    number: int | None = None
    solid: bool = True

    def __post_init__(self) -> None:
        own_numbers(self)
        at = f"kinds.{text(self.name, 'kinds.name')}"
        if self.number is not None:
            whole(self.number, f"{at}.number", 1, KIND_MAX)
        boolean(self.solid, f"{at}.solid")


def numbered(kinds: Iterable[object]) -> tuple[BlockKind, ...]:
    """Returns the kinds of a scene, all with a number.

    Raises:
        SceneError: an entry is no `BlockKind`, a number is above 255, or two kinds have one name or one number.
    """
    found: list[BlockKind] = []
    for i, kind in enumerate(kinds):
        if not isinstance(kind, BlockKind):
            raise SceneError(f"kinds[{i}] = {shown(kind)}: must be a `BlockKind`")
        number = kind.number
        if number is None:
            number = (found[-1].number or 0) + 1 if found else 1
        kind = replace(kind, number=whole(number, f"kinds.{kind.name}.number", 1, KIND_MAX))
        for other in found:
            if kind.name == other.name or kind.number == other.number:
                raise SceneError(f"kinds[{i}]: {kind.name!r} has the name or the number {number} of an earlier kind")
        found.append(kind)
    return tuple(found)


def numbered_fill(fill: Iterable[object], kind: Callable[[str, str], int]) -> list[object]:
    """Returns the terrain's `fill` with the number of a kind in place of each name.

    Args:
        fill: entries whose last item is a number or a name.
        kind: returns the number of a name; its second argument is the field, for the error.
    """
    return [
        [*entry[:-1], kind(entry[-1], "terrain.fill")]
        if isinstance(entry, list | tuple) and entry and isinstance(entry[-1], str)
        else entry
        for entry in fill
    ]
