"""The interface by which the game authenticates clients. `server.auth.tokens` implements it with signed tokens."""

from collections.abc import Callable
from typing import Protocol

from server.observability.errors import FaultReporter
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


def identified(authenticate: Callable[[str], str] | None, token: str, faults: FaultReporter) -> str:
    """Returns the subject of a token; empty if anyone may play.

    Args:
        authenticate: returns the subject, as for `Game`; None: anyone may play.
        token: the token of a client.
        faults: where a wrong result of `authenticate` is reported.

    Raises:
        ValueError: the client is refused, with the reason for it. Other exceptions are those of `authenticate`.
    """
    if authenticate is None:
        return ""
    subject = authenticate(token)
    try:
        return checked_subject(subject)
    except ValueError:
        faults.report("the result of the authenticator")
    raise AuthError("the server's authenticator returned no valid subject")


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
