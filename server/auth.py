"""Who a client is: what the game asks, whatever answers it. `server.tokens` answers from signed tokens."""

from typing import Protocol

from shared.checks import text

SUBJECT_MAX = 64
"""The longest subject, in characters."""


class AuthError(ValueError):
    """The client may not come in; the text says why, and is sent to it."""


def checked_subject(subject: object) -> str:
    """The result of an `Authenticator`, or the subject of a token: a text of at most `SUBJECT_MAX` characters.

    Raises:
        SceneError: it is none, is too long, or UTF-8 cannot hold it.
    """
    return text(subject, "subject", SUBJECT_MAX, shortest=0)


class Authenticator(Protocol):
    """Checks what a client shows. Write your own and name it by `--auth package.module:name`.

    It is called in the event loop, once per client: it must not wait for anything.
    """

    def __call__(self, token: str) -> str:
        """Who the client is: a text of 1 to `SUBJECT_MAX` characters, or empty for nobody in particular.

        Raises:
            AuthError: the client may not come in.
        """
        ...
