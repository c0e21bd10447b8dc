"""The stderr of a child process: passed on as it comes, and its last line kept, to name the cause of a failure."""

import os
import sys
import threading

JOIN_S = 2.0
"""Time for the last words of a child that has ended."""
LINE_MAX = 500


class Stderr:
    """The stderr of one child: start the child with `stderr=stderr.pipe`, then call `started`."""

    def __init__(self) -> None:
        read, self.pipe = os.pipe()
        self._last = ""
        self._thread = threading.Thread(target=self._pass_on, args=(read,), daemon=True)
        self._thread.start()

    def started(self) -> None:
        """The child has its copy of the pipe, so that the pipe ends with the child."""
        os.close(self.pipe)

    def cause(self, code: int | None) -> str:
        """Why a child failed: its last line, or else its exit code; None: it still runs, but does not answer."""
        if code is not None:
            self._thread.join(JOIN_S)
        if self._last:
            return self._last.removeprefix("error: ")
        return "it still runs, but says nothing" if code is None else f"it ended with {code}, without a word"

    def _pass_on(self, read: int) -> None:
        with open(read, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                self._last = line.strip()[:LINE_MAX] or self._last
                sys.stderr.write(line)
                sys.stderr.flush()
