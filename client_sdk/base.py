"""What both kinds of client have in common: the player's side of a core."""

from collections.abc import Mapping
from typing import Any

from client_sdk.linked import LinkedCore
from client_sdk.links import Path
from client_sdk.stats import Stats
from shared.inputs import make_input


class BaseClient:
    """A player on a server.

    Args:
        core: the client's state; read it for whatever is not offered here.
    """

    def __init__(self, core: LinkedCore) -> None:
        self.core = core

    @property
    def joining(self) -> bool:
        """Whether the world is still being fetched: there is nothing to draw yet."""
        return self.core.state == "joining"

    @property
    def playing(self) -> bool:
        """Whether inputs count and there is a world to draw."""
        return self.core.state == "playing"

    @property
    def away(self) -> bool:
        """Whether the connection is lost and the client tries to come back: `Disconnected`, then `Resumed`."""
        return self.core.state == "away"

    @property
    def closed(self) -> bool:
        """Whether it is over; `Left` says why."""
        return self.core.state == "closed"

    @property
    def entity(self) -> int:
        """The own entity; 0 before the server has given one."""
        return self.core.entity

    @property
    def shared(self) -> Mapping[str, Any]:
        """The values that the game shares with all clients."""
        return self.core.shared

    @property
    def stats(self) -> Stats:
        """Counters since the start, and figures of the moment."""
        return self.core.stats

    def overlay(self) -> str:
        """The figures that matter as a few lines of text, to draw over the picture (`stats.figures`: in pairs)."""
        return self.core.stats.text()

    @property
    def link(self) -> Path | None:
        """A worse connection than there is, to feel one while developing: `client.link = "wifi"`.

        Any preset of `client_sdk.links`, or a `Path` of one's own; None: none. May change at any time.

        Raises:
            ValueError: there is no preset of that name.
        """
        return self.core.link

    @link.setter
    def link(self, link: str | Path | None) -> None:
        self.core.link = link

    def set_input(self, x: float, y: float, *, jump: bool = False) -> None:
        """Sets the player's input from now on: a direction (east, north) of length 0 to 1, and whether to jump.

        Call it as often as you like. A jump that is set and taken back between two ticks counts in the next tick.

        Raises:
            ValueError: the direction is not finite.
        """
        self.core.set_input(make_input(x, y, jump=jump))

    def set_input_delay(self, ticks: int) -> None:
        """Shows the effect of inputs so many ticks (0 to 3) after `set_input`; may change at any time.

        The more, the fewer and smaller the corrections caused by others on a slow connection, and the slower the
        controls feel: 2 ticks at 32 a second are 63 ms.

        Raises:
            ValueError: not 0 to 3.
        """
        self.core.set_input_delay(ticks)
