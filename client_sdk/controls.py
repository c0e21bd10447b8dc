"""The player's current input, and the buttons that were pressed and released between two ticks."""

from shared.aim import NO_AIM
from shared.buttons import Names, held_names
from shared.inputs import NEUTRAL, Input
from shared.scene import Scene


class Controls:
    """The source of the inputs of the next ticks.

    A button that is pressed between two ticks counts in the next tick's input, even if it is released before that tick;
    the input then has the aim of that press. A button that is held counts in every tick.
    """

    def __init__(self) -> None:
        self.held = NEUTRAL
        """The input that was set most recently."""
        self.used = False
        """Whether an input was ever set."""
        self.delay = 0
        """Input delay in ticks, 0 to 3: inputs are filed this far ahead of the predicted world."""
        self._pressed = 0
        """Bits of the buttons that were pressed since the latest tick."""
        self._aimed = NO_AIM
        """Aim of the latest press; none: it had none."""
        self._unresolved: tuple[str, ...] | None = None
        """Names of held buttons whose bits are not known yet; None: there are none, and the aim is checked."""

    def set(self, input_: Input, names: Names = (), scene: Scene | None = None) -> None:
        """Sets the input from now on.

        Args:
            input_: the input.
            names: further buttons that are held, by name.
            scene: the scene; None: it is not known yet, and `resolve` checks names and aim.

        Raises:
            SceneError: the scene has no such button, or no aim.
        """
        self.used = True
        named = held_names(names) if names != () else ()
        if scene is not None and (named or input_.aim != NO_AIM):
            scene.check_aim(input_.aim)
            input_ = input_._replace(buttons=input_.buttons | scene.buttons_bits(named))
        self._unresolved = named if scene is None else None
        pressed = input_.buttons & ~self.held.buttons
        if pressed:
            self._pressed |= pressed
            self._aimed = input_.aim if scene is not None else NO_AIM  # not checked yet
        self.held = input_

    def resolve(self, scene: Scene | None) -> None:
        """Finds the bits of the buttons that were set before the scene was known. Does nothing if there are none.

        Raises:
            SceneError: the scene has no such button, or no aim. This is raised once: the input then has no buttons by
                name and no aim.
        """
        if self._unresolved is None or scene is None:
            return
        names, held = self._unresolved, self.held
        self._unresolved, self.held = None, held._replace(aim=NO_AIM)
        self.set(held, names, scene)

    def take(self) -> Input:
        """Returns the input of the next tick, including buttons that were pressed and released before it."""
        pressed, self._pressed = self._pressed, 0
        if not pressed:
            return self.held
        released = pressed & ~self.held.buttons
        aim = self._aimed if released and self._aimed != NO_AIM else self.held.aim
        return self.held._replace(buttons=self.held.buttons | pressed, aim=aim)

    def restart(self) -> None:
        """Forgets the input, because it was made for another scene."""
        self.held, self._unresolved = NEUTRAL, None
        self.forget()

    def forget(self) -> None:
        """Forgets presses, because the tick that they were meant for has no input."""
        self._pressed = 0
