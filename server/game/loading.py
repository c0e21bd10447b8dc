"""Loading: what a game fetches for a player before the join, while ticks go on and the client waits.

The rules' coroutine `load_player` is handed to a *runner*, which calls back with its result. On a server the runner is
an event loop (`server.runtime.tasks`). Without one, as in a match or a loopback, the coroutine runs at once and must
not await anything that takes time.
"""

from collections.abc import Callable, Coroutine
from typing import Any

from server.observability.errors import FaultReporter
from shared import messages

Done = Callable[[Any, BaseException | None], None]
"""Function that takes the result of a coroutine, or its exception."""
Runner = Callable[[Coroutine[Any, Any, Any], Done], None]
"""Function that runs a coroutine, and calls the given function once in the thread that ticks, between two ticks."""


def at_once(coroutine: Coroutine[Any, Any, Any], done: Done) -> None:
    """Runs a coroutine to its end without an event loop: the default runner."""
    try:
        coroutine.send(None)
    except StopIteration as finished:
        done(finished.value, None)
    except Exception as error:
        done(None, error)
    else:
        coroutine.close()
        done(None, RuntimeError("load_player awaits something that takes time: this needs a server, or its event loop"))


def not_loaded(error: BaseException, faults: FaultReporter) -> tuple[int, str]:
    """Returns the close code and the reason for a client whose `load_player` has raised.

    Args:
        error: the exception. A `ValueError` of the rules refuses the client; any other one is a fault.
        faults: where a fault is reported.
    """
    if isinstance(error, ValueError):
        return messages.NOT_ADMITTED, str(error) or "the game refused the player"
    try:
        raise error
    except Exception:
        faults.report("load_player")
    return messages.INTERNAL, "the game could not load the player's data"
