"""Who a client is: what the game asks, whatever answers it. `server.tokens` answers from signed tokens."""

from typing import Protocol

SUBJECT_MAX = 64
"""No subject is longer, in characters."""


class AuthError(ValueError):
    """The client may not come in; the text says why, and is sent to it."""


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
