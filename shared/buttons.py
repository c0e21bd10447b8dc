"""The names of a scene's buttons, and the bits of `Input.buttons` that they stand for.

"jump" is always bit 0, because the physics reads it there. The other buttons have the bits 1, 2, ... in the order of
the scene's list.
"""

from collections.abc import Iterable, Mapping

from shared.checks import SceneError, boolean, items, shown, text
from shared.inputs import JUMP

JUMP_NAME = "jump"
"""Name of the button whose bit is `JUMP`."""
DEFAULT_BUTTONS = (JUMP_NAME,)
"""Buttons of a scene that names none."""
BUTTONS_COUNT_MAX = 8
"""Limit of the buttons of a scene, bit 0 included: `Input.buttons` has 8 bits."""
BUTTON_NAME_MAX = 32
"""Longest name of a button, in characters."""

Names = str | Iterable[str] | Mapping[str, object]
"""Buttons by name: one name, several, or a table of names with whether each is held."""


def checked_buttons(buttons: object) -> tuple[str, ...]:
    """Returns the names of a scene's buttons as a tuple.

    Raises:
        SceneError: a name is not valid or stands there twice, or there are too many.
    """
    names = tuple(text(name, f"buttons[{i}]", BUTTON_NAME_MAX) for i, name in enumerate(items(buttons, "buttons")))
    for i, name in enumerate(names):
        if name in names[:i]:
            raise SceneError(f"buttons[{i}] = {shown(name)}: is in the list twice")
    most = BUTTONS_COUNT_MAX - (JUMP_NAME not in names)
    if len(names) > most:
        room = "" if JUMP_NAME in names else f" besides {JUMP_NAME!r}, whose bit stays unused"
        raise SceneError(f"buttons: {len(names)} of them; must be at most {most}{room}")
    return names


def bits_of(names: tuple[str, ...]) -> dict[str, int]:
    """Returns the bit of each of a scene's buttons, by name."""
    others = [name for name in names if name != JUMP_NAME]
    bits = {name: JUMP << place for place, name in enumerate(others, 1)}
    return {name: bits.get(name, JUMP) for name in names}


def held_names(buttons: object, at: str = "buttons") -> tuple[str, ...]:
    """Returns the names of the buttons that are held.

    Args:
        buttons: one name, several, or a table of names with whether each is held (a truth value, or 0 and 1).
        at: name of the argument, for the error.

    Raises:
        SceneError: it is none of these.
    """
    if isinstance(buttons, str):
        return (buttons,)
    if isinstance(buttons, Mapping):
        named = {name: held for name, held in buttons.items() if isinstance(name, str)}
        if len(named) == len(buttons):
            return tuple(name for name, held in named.items() if _held(held, f"{at}[{name!r}]"))
    elif isinstance(buttons, Iterable) and not isinstance(buttons, bytes):
        names = tuple(buttons)
        if all(isinstance(name, str) for name in names):
            return names
    raise SceneError(f"{at} = {shown(buttons)}: must be names of buttons, or a table of names and truth values")


def _held(held: object, at: str) -> bool:
    return bool(held) if isinstance(held, int) else boolean(held, at)
