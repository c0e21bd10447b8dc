"""The messages that begin and end a connection. `shared.messages` lists all messages."""

from typing import Any, NamedTuple


class Hello(NamedTuple):
    """The first message of a client.

    `scene` has the digests of the scene that the client was built for; it is empty if the client accepts any scene.
    """

    version: int
    scene: dict[str, bytes]
    name: str
    token: str = ""
    resume: bytes = b""


class Beside(NamedTuple):
    """The first message of a second connection, over which the player goes on."""

    version: int
    token: str
    resume: bytes


class Bye(NamedTuple):
    """The last message before the connection closes, from either side.

    `code` is the close code. `wait` is the time in seconds after which to connect again; negative: do not.
    """

    code: int
    reason: str
    wait: float


class Welcome(NamedTuple):
    """The answer to `Hello` for an accepted client: its entity, the scene and a resume token.

    `tick` is the server's tick, and `scene` the table of `Scene.to_table`.
    """

    version: int
    tick: int
    entity: int
    scene: dict[str, Any]
    resume: bytes = b""
