"""The messages of a server about its games and its worlds. `shared.messages` lists all messages."""

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


class Go(NamedTuple):
    """A request to connect to another path of this server, and to join the world there as a new player.

    `path` is the path of a WebSocket request, with a reserved seat if there is one; if the world is at another server,
    the server's address stands in front of it. `code` is the code of a private world, or empty. `seats` has the paths
    of the seats that were reserved for the client's friends. `reason` says why the client goes.
    """

    path: str
    code: str
    seats: list[str]
    reason: str


class Waiting(NamedTuple):
    """Progress while a client waits for a world; the payload is a MessagePack table."""

    payload: bytes


class Edges(NamedTuple):
    """The addresses of other servers of the same world. After a lost connection, the client may go on at any of them.

    On a connection where this message has come, `Announce` does not count for `NextHappened`.
    """

    addresses: list[str]


class HandOver(NamedTuple):
    """A request to go on at another server of the same world, over a second connection that begins with `Beside`."""

    address: str
    reason: str
