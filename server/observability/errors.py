"""Exceptions that are our own mistake: each one costs what it happened in and no more, is counted, and is told of."""

import logging
import sys
from collections import Counter

logger = logging.getLogger(__name__)


class Faults:
    """Counts exceptions by the place where they were raised; of each place the 1st, 10th, 100th, ... are logged.

    Args:
        whose: begins the line in the log.
    """

    def __init__(self, whose: str = "internal error") -> None:
        self.total = 0
        self._whose = whose
        self._places: Counter[tuple[str, str, int]] = Counter()

    def report(self, where: str) -> None:
        """To be called where an exception is being handled; `where` says what has been given up because of it."""
        self.total += 1
        error = sys.exception()
        trace = error.__traceback__ if error is not None else None
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        place = ("", 0) if trace is None else (trace.tb_frame.f_code.co_filename, trace.tb_lineno)
        self._places[where, *place] += 1
        times = self._places[where, *place]
        if str(times).strip("0") == "1":
            logger.exception("%s in %s (no. %d at this place)", self._whose, where, times)
