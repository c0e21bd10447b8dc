"""The connection to a bus, watched: logs its losses and counts its returns."""

import logging

logger = logging.getLogger(__name__)


class Watched:
    """The state of a connection to a bus, and the functions that its library calls."""

    def __init__(self) -> None:
        self.closing = False
        self.times_back = 0
        """Number of reconnects."""

    async def failed(self, error: Exception) -> None:
        """Logs an error. There is one for each attempt to reconnect."""
        logger.debug("the bus: %s", said(error))

    async def lost(self) -> None:
        """Logs that the connection is lost, unless it is closed here."""
        if not self.closing:
            logger.warning("the connection to the bus is lost")

    async def back(self) -> None:
        """Logs that there is a connection again."""
        self.times_back += 1
        logger.info("the connection to the bus is back")


def said(error: BaseException) -> str:
    """Returns the text of an error, or its kind if it has none."""
    return str(error) or type(error).__name__
