"""The check of a store whose world another process may take over (`server.worlds.lease`).

Another process copies the files once this one has lost its lease. What was written before that is in the copy, and
counts. It is checked after each write, too: if the lease is lost by then, the copy may lack it, so it does not
count, and no client gets an answer that promises it.
"""

import contextlib
from collections.abc import Callable, Iterator


class Owned:
    """A store that checks whether this process still has its world."""

    owned: Callable[[], bool] | None = None
    """Whether this process still has the world; None: no other process can take it. May be called from any thread."""

    @contextlib.contextmanager
    def _owning(self) -> Iterator[None]:
        """Checks before and after a write that this process has the world.

        Raises:
            OSError: it has lost it.
        """
        self._check_owned()
        yield
        self._check_owned()

    def _check_owned(self) -> None:
        if self.owned is not None and not self.owned():
            raise OSError("this process has lost its lease")
