"""The side of a core that the program talks to: inputs, commands and edits in, events and a view out."""

from collections.abc import Iterable
from typing import Any, SupportsIndex

from client_sdk.commands import SentCommands
from client_sdk.controls import Controls
from client_sdk.events import Event
from client_sdk.input_loop import InputLoop
from client_sdk.pending_events import PendingEvents
from client_sdk.prediction.prediction import Prediction
from client_sdk.stats import Stats
from client_sdk.timing.server_clock import ServerClock
from client_sdk.timing.timeline import Timeline
from client_sdk.view import NOTHING, View
from client_sdk.worlds import Worlds
from shared import edits, messages
from shared.behaviours import Behaviour, checked_classes
from shared.buttons import Names
from shared.checks import SceneError, shown, whole
from shared.inputs import Input, checked_input, clamp
from shared.scene import Scene

INPUT_DELAY_MAX = 3
"""Longest input delay, in ticks."""


class ProgramSide:
    """A part of `client_sdk.core.Core`, which explains the arguments."""

    def __init__(
        self,
        scene: Scene | None,
        behaviours: Iterable[type[Behaviour]],
        *,
        compiled: bool | None,
        neighbours: bool,
    ) -> None:
        if scene is not None and not isinstance(scene, Scene):
            raise SceneError(f"scene = {shown(scene)}: must be a `Scene`, or None for the server's")
        self.scene = scene
        self.state = "joining"
        self.stats = Stats()
        self.controls = Controls()
        self.behaviours = checked_classes(behaviours)
        self._open = False
        self._out: list[bytes] = []
        self._commands = SentCommands()
        self._events = PendingEvents()
        self._worlds = Worlds(
            self.stats,
            self._events,
            self.controls,
            self.behaviours,
            compiled=compiled,
            neighbours=neighbours,
        )

    @property
    def prediction(self) -> Prediction | None:
        """The confirmed and the predicted world; None before the welcome."""
        world = self._worlds.current
        return world.prediction if world else None

    @property
    def entity(self) -> int:
        """The number of the own entity; 0 before the welcome."""
        world = self._worlds.current
        return world.prediction.entity if world else 0

    @property
    def clock(self) -> ServerClock:
        """The estimate of the server time."""
        return self._worlds.clock

    @property
    def timeline(self) -> Timeline | None:
        """The client's own time in ticks; None before the client has joined."""
        play = self._worlds.play
        return play.timeline if play else None

    @property
    def waiting(self) -> int:
        """The number of events that the program has not taken."""
        return len(self._events)

    @property
    def connected(self) -> bool:
        """Whether there is a connection, as far as the core knows."""
        return self._open

    def command(self, name: str, data: Any = None) -> int:
        """Sends a command to the rules of the game, for the next tick. Returns its number, which `Answered` repeats.

        Raises:
            RuntimeError: the client has not joined.
            ValueError: the name or the data are too long (32 characters, 1,024 bytes), or MessagePack cannot hold the
                data.
        """
        play = self._joined("command")
        tick = self._commands.tick(play.world.prediction.next_order)
        return self._order(self._commands.command(tick, play.seen, name, data))

    def edit(self, x: SupportsIndex, y: SupportsIndex, z: SupportsIndex, kind: SupportsIndex) -> int:
        """Places (kind 1 to 255) or removes (0) a block with the next tick. Returns the number of the edit.

        Raises:
            RuntimeError: the client has not joined.
            TypeError: an argument is not a whole number.
            EditError: an argument is out of range (a `ValueError`).
        """
        play, edit = self._joined("edit"), edits.checked(x, y, z, kind)
        payload = edits.pack(edit)  # before the prediction: an edit that cannot be sent must not be predicted
        number = self._commands.number()
        tick = self._commands.tick(play.world.prediction.next_order)
        play.world.prediction.edit(number, tick, edit)
        return self._order(messages.Command(number, tick, play.seen, edits.NAME, payload))

    @property
    def input(self) -> Input:
        """The input that was set most recently."""
        return self.controls.held

    def set_input(self, input_: Input, buttons: Names = ()) -> None:
        """Sets the player's input from the next tick on. A short press between two ticks counts in the next tick.

        Args:
            input_: the input.
            buttons: buttons that are held besides, by name. `Controls.resolve` finds their bits if the scene is not
                known yet; the clients call it ahead of each update.

        Raises:
            ValueError: `input_` is not an `Input`, or the scene has no such button or no aim.
        """
        self.controls.set(clamp(checked_input(input_, "input")), buttons, self.scene)

    def set_input_delay(self, ticks: int) -> None:
        """Sets the input delay: inputs take effect `ticks` ticks (0 to 3) later. More delay means fewer replays.

        Raises:
            ValueError: `ticks` is not 0 to 3.
        """
        self.controls.delay = whole(ticks, "ticks", 0, INPUT_DELAY_MAX)

    def events(self) -> list[Event]:
        """Returns the events since the last call, oldest first."""
        return self._events.take() if self._events else []

    def view(self, now: float) -> View:
        """Returns what to draw now: the own entity as predicted, the others a little in the past."""
        play = self._worlds.play
        return play.view(now) if play else NOTHING

    def _joined(self, what: str) -> InputLoop:
        play = self._worlds.play
        if play is None or self.state == "closed":
            raise RuntimeError(f"{what}: the client has not joined")
        return play

    def _order(self, command: messages.Command) -> int:
        """Sends a command now, or over the next connection. Returns its number."""
        message = self._commands.file(command)
        if self._open:
            self._out.append(message)
        return command.number
