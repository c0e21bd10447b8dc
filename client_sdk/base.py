"""The part that `Client` and `AsyncClient` have in common: the player's side of a core."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

from client_sdk.diagnosis import Diagnosis, Use, diagnosis
from client_sdk.stats import Stats
from client_sdk.view import View
from shared.buttons import Names
from shared.checks import Cell
from shared.inputs import make_input

if TYPE_CHECKING:
    from client_sdk.core import Core
    from client_sdk.drawn import Drawn
    from client_sdk.netsim.linked import LinkedPort
    from client_sdk.netsim.links import Link
    from shared.arrays import Uint8s


class BaseClient:
    """A player on a server.

    Args:
        core: the client's state machine; read it for what this class does not offer.
    """

    def __init__(self, core: "Core") -> None:
        from client_sdk.picture_blocks import PictureBlocks  # here, because an import of this class stays cheap

        self.core = core
        self._picture_blocks = PictureBlocks(core)

    @property
    def joining(self) -> bool:
        """Whether the client still waits for the world, so that there is nothing to draw yet."""
        return self.core.state == "joining"

    @property
    def playing(self) -> bool:
        """Whether inputs count and there is a world to draw.

        A `Client` becomes `playing` in `update`, so a program has to call `update` as well as `poll` each frame: with
        `poll` alone the client stays `joining`. An `AsyncClient` does both by itself.
        """
        return self.core.state == "playing"

    @property
    def reconnecting(self) -> bool:
        """Whether the connection is lost and the client tries to reconnect: after `Disconnected`, before `Resumed`."""
        return self.core.state == "reconnecting"

    @property
    def closed(self) -> bool:
        """Whether the connection is over for good; the event `Left` says why."""
        return self.core.state == "closed"

    @property
    def entity(self) -> int:
        """The number of the own entity; 0 before the server has sent it."""
        return self.core.entity

    @property
    def world(self) -> str:
        """The name of the world; empty in the default world, and as long as the server looks for one."""
        return self.core.travel.world

    @property
    def code(self) -> str:
        """The code of the world if it is a private one, for friends to join: `Client.join(url, code=...)`."""
        return self.core.travel.code

    @property
    def seats(self) -> tuple[str, ...]:
        """The seats that were reserved for others, one for each player: `Client.join(url, seat=...)`."""
        return self.core.travel.seats

    @property
    def shared(self) -> Mapping[str, Any]:
        """The values that the rules of the game share with all clients, by name."""
        return self.core.shared

    @property
    def private(self) -> Mapping[str, Any]:
        """The values that the rules of the game share with this player only, by name."""
        return self.core.private

    @property
    def stats(self) -> Stats:
        """Counters since the start, and current measurements such as the round trip."""
        return self.core.stats

    def overlay(self) -> str:
        """Returns the most useful statistics as a few lines of text, to draw over the view.

        `stats.figures()` returns them as pairs of name and value.
        """
        return self.core.stats.text()

    @property
    def link(self) -> "Link | None":
        """The simulated link on top of the real connection, to try a bad network: `client.link = "wifi"`.

        It may be set at any time: to the name of a preset of `client_sdk.netsim.links`, to a `Link`, or to None for no
        link.

        Raises:
            ValueError: no preset has that name.
        """
        return None if self.core.port is self.core else cast("LinkedPort", self.core.port).link

    @link.setter
    def link(self, link: "str | Link | None") -> None:
        set_link(self.core, link)

    def set_input(
        self, x: float, y: float, *, jump: bool = False, buttons: Names = (), aim: Sequence[float] | None = None
    ) -> None:
        """Sets the player's input from now on. May be called at any time, also several times per tick.

        A button that is pressed and released between two ticks counts in the next tick. `Scene.buttons` and `Scene.aim`
        say what there is. Before the client knows the scene, buttons by name and an aim are kept; if the scene has no
        such button or no aim, the first `update` that knows it raises the `ValueError` instead, once.

        Args:
            x: east part of the direction. The length of (x, y) is the share of full speed; above 1 counts as 1.
            y: north part of the direction.
            jump: whether to jump as soon as the entity can.
            buttons: the buttons that are held: names, as in ("dash",), or a table of names and truth values, as in
                {"dash": key_down}.
            aim: direction (x, y, z) in space, of any length; None: no aim.

        Raises:
            ValueError: the direction or the aim is not finite, or the scene has no such button or no aim.
        """
        self.core.set_input(make_input(x, y, jump=jump, aim=aim), buttons)

    def set_input_delay(self, ticks: int) -> None:
        """Sets the input delay: the effect of an input is shown `ticks` ticks later. May be called at any time.

        A longer delay means fewer and smaller corrections caused by others on a slow connection, and slower controls:
        2 ticks at 32 ticks per second are 63 ms.

        Args:
            ticks: 0 to 3.

        Raises:
            ValueError: `ticks` is not 0 to 3.
        """
        self.core.set_input_delay(ticks)

    def edit(self, x: int, y: int, z: int, kind: int) -> int:
        """Places or removes one block with the next tick. The client predicts the change and shows it at once.

        The server may refuse it: the block is out of reach, an entity is in the way, or there were too many edits. The
        client then takes the change back by itself.

        Args:
            x: east, in blocks.
            y: north, in blocks.
            z: up, in blocks.
            kind: the block to place, 1 to 255; 0 removes the block.

        Returns:
            The number of the edit. The event `Answered` with this number brings the result.

        Raises:
            RuntimeError: the client has not joined.
            TypeError: an argument is not a whole number.
            ValueError: an argument is out of range.
        """
        number = self.core.edit(x, y, z, kind)
        self._filed()
        return number

    def command(self, name: str, data: Any = None) -> int:
        """Sends a request to the rules of the game, which define what `name` and `data` mean.

        Args:
            name: name of the command, up to 32 characters.
            data: any value that MessagePack can hold, up to 1,024 bytes when packed.

        Returns:
            The number of the command. The event `Answered` with this number brings the result.

        Raises:
            RuntimeError: the client has not joined.
            ValueError: the name or the data are too long, or MessagePack cannot hold the data.
        """
        number = self.core.command(name, data)
        self._filed()
        return number

    def block(self, x: int, y: int, z: int) -> int | None:
        """Returns the kind of a block as the client shows it, 0 for air; None if its segment is not loaded."""
        return self._picture_blocks.block(x, y, z)

    def segment(self, index: Cell) -> "Uint8s":
        """Returns the kinds of a segment's blocks, [z, y, x], 32 each, as a copy; air if it is not loaded."""
        return self._picture_blocks.segment(index)

    def blocks_changed(self) -> set[Cell]:
        """Returns the segments whose blocks have changed, arrived or gone since the last call, to draw them anew.

        The first call returns all loaded segments. Own edits count at once; an edit that is taken back counts again.
        """
        return self._picture_blocks.changed()

    def diagnosis(self) -> Diagnosis:
        """Returns a verdict on the prediction in plain words, what to do about it, and warnings of wrong use.

        It is meant for developers; the panel of `scripts/play` (F3) shows it.
        """
        core, scene = self.core, self.core.scene
        use = Use(core.waiting, core.stats.played_s, core.controls.used, bool(scene and scene.behaviours))
        return diagnosis(core.stats, use)

    def drawn(self, view: View) -> "Drawn":
        """Returns the other entities of a view and the blocks, for rays and boxes: a hit that is judged ahead.

        A program shows the hit as a guess, and sends the shot as a command. The rules judge it by `game.rewound`, and
        `Answered` with the number of the command brings their word.

        Raises:
            RuntimeError: the client has not joined.
        """
        from client_sdk.drawn import Drawn

        prediction, scene = self.core.prediction, self.core.scene
        if prediction is None or scene is None:
            raise RuntimeError("drawn: the client has not joined")
        return Drawn(view, scene, prediction)

    def _filed(self) -> None:
        """Called after a command has been filed, for a client that sends it at once; others send with `update`."""


def set_link(core: "Core", link: "str | Link | None") -> None:
    """Puts a simulated link in front of a core, or changes it. Without a link, the simulator is not even loaded.

    Raises:
        ValueError: no preset has the name in `link`.
    """
    if core.port is core:
        if link is None:
            return
        from client_sdk.netsim.linked import LinkedPort

        core.port = LinkedPort(core)
    cast("LinkedPort", core.port).link = link
