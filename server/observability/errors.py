"""Faults: exceptions in our own code. They are counted and logged, and end only the operation in which they occur."""

import logging
import sys
from collections import Counter

logger = logging.getLogger(__name__)


class FaultReporter:
    """Counts exceptions by the place where they were raised, and logs the 1st, 10th, 100th, ... of each place.

    Args:
        prefix: beginning of the line in the log.
    """

    def __init__(self, prefix: str = "internal error") -> None:
        self.total = 0
        self._prefix = prefix
        self._places: Counter[tuple[str, str, int]] = Counter()

    def report(self, where: str) -> None:
        """Counts the exception that is being handled. Call it in an `except` block.

        Args:
            where: the operation that the exception has ended, for the log.
        """
        self.total += 1
        error = sys.exception()
        trace = error.__traceback__ if error is not None else None
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        place = ("", 0) if trace is None else (trace.tb_frame.f_code.co_filename, trace.tb_lineno)
        self._places[where, *place] += 1
        times = self._places[where, *place]
        if str(times).strip("0") == "1":
            logger.exception("%s in %s (no. %d at this place)", self._prefix, where, times)
