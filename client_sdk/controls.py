"""The player's current input, and the buttons that were pressed and released between two ticks."""

from shared.inputs import NEUTRAL, Input


class Controls:
    """The source of the inputs of the next ticks.

    A button that is pressed between two ticks counts in the next tick's input, even if it is released before that tick.
    A button that is held counts in every tick.
    """

    def __init__(self) -> None:
        self.held = NEUTRAL
        """The input that was set most recently."""
        self.delay = 0
        """Input delay in ticks, 0 to 3: inputs are filed this far ahead of the predicted world."""
        self._pressed = 0
        """Bits of the buttons that were pressed since the latest tick."""

    def set(self, input_: Input) -> None:
        """Sets the input from now on."""
        self._pressed |= input_.buttons & ~self.held.buttons
        self.held = input_

    def take(self) -> Input:
        """Returns the input of the next tick, including buttons that were pressed and released before it."""
        pressed, self._pressed = self._pressed, 0
        return self.held._replace(buttons=self.held.buttons | pressed) if pressed else self.held

    def forget(self) -> None:
        """Forgets presses, because the tick that they were meant for has no input."""
        self._pressed = 0
