"""The interfaces between the worlds of a server and their surroundings."""

from collections.abc import Callable
from typing import Any, Protocol

from server.game import Game
from server.worlds.hosted import HostedWorld


class Host(Protocol):
    """The surroundings of the worlds: it makes their games and runs their ticks."""

    def begin(self, world: HostedWorld) -> Game:
        """Returns the game of a new world. Raises `WorldsError`: it cannot be made."""
        ...

    def wake(self, world: HostedWorld) -> None:
        """Starts the ticks of a world."""

    def rest(self, world: HostedWorld) -> None:
        """Stops the ticks of a world that nobody is in."""

    def ended(self, world: HostedWorld, *, keep: bool) -> None:
        """Takes the end of a world.

        Args:
            world: the world; its connections are closed.
            keep: whether its data are kept, because it may come back.
        """


class Way(Protocol):
    """The way that a path leads: into a world, or into the lobby."""

    @property
    def receive(self) -> Callable[[Any, bytes, float], None]:
        """Function that takes one message of a session."""
        ...

    @property
    def lost(self) -> Callable[[Any, float], None]:
        """Function that takes the end of a session."""
        ...

    def open(self, link: Any, now: float) -> Any:
        """Adds a connection and returns its session."""
