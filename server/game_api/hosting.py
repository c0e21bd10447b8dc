"""The interface through which the rules of one world use the others; `server.worlds.api` implements it."""

from typing import Any, Protocol

from shared.messages import Go


class WorldsError(ValueError):
    """A world that cannot be made, found or used. The text is the reason, for players and operators."""


class Hosting(Protocol):
    """The worlds of a server, as the rules of one of them see them."""

    @property
    def name(self) -> str:
        """The name of this world; empty: it is the default world."""
        ...

    @property
    def kind(self) -> str:
        """The name of this world's kind; empty: it is the default world."""
        ...

    @property
    def code(self) -> str:
        """The code of this world if it is private; otherwise empty."""
        ...

    @property
    def properties(self) -> dict[str, Any]:
        """The properties of this world, as a copy."""
        ...

    def create(self, kind: str, *, private: bool = False, **properties: Any) -> str:
        """Makes a world and returns its name. Raises `WorldsError`: it cannot be made."""
        ...

    def entries(self, kind: str | None = None) -> list[dict[str, Any]]:
        """Returns the entries of all worlds, or of those of a kind: name, kind, players, properties and so on."""
        ...

    def lock(self) -> None:
        """Lets nobody in any more but players with a seat and players who reconnect."""

    def unlock(self) -> None:
        """Lets players in again."""

    def describe(self, **properties: Any) -> None:
        """Sets properties of this world, which the list of worlds shows; None removes one."""

    def end(self, reason: str = "the game is over") -> None:
        """Ends this world after the present tick. Its players get the reason with `Left`."""

    def seat(self, world: str, subject: str, data: Any, reason: str) -> Go:
        """Reserves a seat in another world. Returns the message that sends a client there."""
        ...
