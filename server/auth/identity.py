"""The interface by which the game authenticates clients. `server.auth.tokens` implements it with signed tokens."""

from typing import Protocol

from server.players.player import SUBJECT_MAX as SUBJECT_MAX
from shared.checks import text


class AuthError(ValueError):
    """A client that is refused. The message is the reason and is sent to the client."""


def checked_subject(subject: object) -> str:
    """Checks a subject, the name by which an `Authenticator` identifies a client, and returns it.

    Raises:
        SceneError: it is not a text of at most `SUBJECT_MAX` characters, or UTF-8 cannot encode it.
    """
    return text(subject, "subject", SUBJECT_MAX, shortest=0)


class Authenticator(Protocol):
    """A function that checks the token of a client. Name your own by `--auth package.module:name`.

    The game calls it once per client, in the event loop: it must not wait.
    """

    def __call__(self, token: str) -> str:
        """Returns the subject that identifies the client: at most `SUBJECT_MAX` characters; empty: anonymous.

        A player who reconnects must have the subject that it had before.

        Args:
            token: the token from the client's hello; empty if it sent none.

        Raises:
            AuthError: the client is refused.
        """
        ...
