"""The keys of a game's buttons: those that its rules name, and the window's own choice for the others."""

from collections.abc import Callable, Mapping

import pygame

from shared.buttons import JUMP_NAME

CHOICE = ("left shift", "e", "q", "f", "r", "c", "x")
"""Keys of buttons that the rules name no key for, in turn."""
MOUSE = {"left mouse": -1, "middle mouse": -2, "right mouse": -3}
"""Numbers of the mouse buttons. Keys have positive numbers."""


class Keys:
    """The keys of a scene's buttons.

    Args:
        buttons: names of the buttons.
        wanted: names of keys, by button, as the rules give them (`Rules.keys`).

    Raises:
        RuntimeError: there is no such key.
    """

    def __init__(self, buttons: tuple[str, ...], wanted: Mapping[str, str]) -> None:
        free = [key for key in CHOICE if key not in wanted.values()]
        self.names: dict[str, str] = {}
        """Names of the keys, by button."""
        for button in buttons:
            own = "space" if button == JUMP_NAME and "space" not in wanted.values() else ""
            name = wanted.get(button) or own or (free.pop(0) if free else "")
            if name:
                self.names[button] = name
        self._codes = {button: _code(button, name) for button, name in self.names.items()}

    def __contains__(self, code: object) -> bool:
        return code in self._codes.values()

    def held(self, down: Callable[[int], bool]) -> tuple[str, ...]:
        """Returns the buttons whose keys are down.

        Args:
            down: whether the key, or with a negative number the mouse button, is down.
        """
        return tuple(button for button, code in self._codes.items() if down(code))

    def text(self) -> str:
        """Returns a line that names each key and its button."""
        return "    ".join(f"{name[0].upper()}{name[1:]}: {button}" for button, name in self.names.items())


def commands_of(wanted: Mapping[str, str], commands: Mapping[str, object]) -> dict[int, str]:
    """Returns the declared commands that have a key, by the number of the key.

    Args:
        wanted: names of keys, by button or command, as the rules give them.
        commands: the commands that the rules declare.

    Raises:
        RuntimeError: there is no such key.
    """
    return {_code(name, wanted[name]): name for name in commands if name in wanted}


def _code(button: str, name: str) -> int:
    if name in MOUSE:
        return MOUSE[name]
    try:
        return pygame.key.key_code(name)
    except ValueError:
        raise RuntimeError(f"keys.{button} = {name!r}: there is no such key") from None
