"""The player's input: held from one `set` to the next, and buttons that were pressed and released between two ticks."""

from shared.inputs import NEUTRAL, Input


class Controls:
    """The input for the ticks to come.

    A button that is pressed between two ticks counts in the next tick's input, even if it is released before. One that
    was down in a tick counts as long as it is held.
    """

    def __init__(self) -> None:
        self.held = NEUTRAL
        """The input as it is now."""
        self._pressed = 0
        """Bits of the buttons that were pressed since the latest tick."""

    def set(self, wish: Input) -> None:
        """Sets the input from now on."""
        self._pressed |= wish.buttons & ~self.held.buttons
        self.held = wish

    def take(self) -> Input:
        """Returns the input of the next tick; what was pressed before counts in this one only."""
        pressed, self._pressed = self._pressed, 0
        return self.held._replace(buttons=self.held.buttons | pressed) if pressed else self.held

    def forget(self) -> None:
        """Forgets presses: the tick that they were meant for has no input."""
        self._pressed = 0
