"""The stderr of a child process: passes it on at once and keeps its last line, to name the cause of a failure."""

import os
import sys
import threading

JOIN_S = 2.0
"""Seconds to wait for the last output of a child that has ended."""
LINE_MAX = 500


class Stderr:
    """The stderr of one child: start the child with `stderr=stderr.pipe`, then call `started`."""

    def __init__(self) -> None:
        read, self.pipe = os.pipe()
        self._last = ""
        self._thread = threading.Thread(target=self._pass_on, args=(read,), daemon=True)
        self._thread.start()

    def started(self) -> None:
        """Closes this process's write end of the pipe. The child has its own copy, so the pipe ends with the child."""
        os.close(self.pipe)

    def cause(self, code: int | None) -> str:
        """Returns why a child failed: its last line on stderr, or its exit code if it wrote none.

        Args:
            code: the exit code; None if the child still runs but does not answer.
        """
        if code is not None:
            self._thread.join(JOIN_S)
        if self._last:
            return self._last.removeprefix("error: ")
        return (
            "it still runs, but does not answer"
            if code is None
            else f"it ended with exit code {code} and wrote no error"
        )

    def _pass_on(self, read: int) -> None:
        with open(read, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                self._last = line.strip()[:LINE_MAX] or self._last
                sys.stderr.write(line)
                sys.stderr.flush()
