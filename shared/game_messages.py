"""The messages of a server with which the rules of a game reach its clients. `shared.messages` lists all messages."""

from typing import Any, NamedTuple


class Happened(NamedTuple):
    """A game event, which the rules sent at the end of `tick`."""

    tick: int
    name: str
    payload: bytes


class Announce(NamedTuple):
    """A game event that the behaviour of `entity` has announced in `tick` (`shared.body.Body.announce`)."""

    tick: int
    entity: int
    name: str
    payload: bytes


class Shared(NamedTuple):
    """All shared values of the game, by name."""

    values: dict[str, Any]


class NextHappened(NamedTuple):
    """The number of the next `Happened`, counted from the player's first one; earlier ones not received are lost."""

    number: int


class Refusal(NamedTuple):
    """The reason that the rules gave for refusing a command; it comes ahead of the snapshot with the verdict."""

    number: int
    reason: str


class Private(NamedTuple):
    """All values of the game that only this player gets, by name."""

    values: dict[str, Any]
