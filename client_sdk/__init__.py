"""Play on a Sovereign Netcode server: prediction, reconciliation, interpolation.

    from client_sdk import Client, Joined, Left

`Client` is for a game's own loop, `AsyncClient` for asyncio, `Loopback` for a server within the program. They return
events (`client_sdk.events`), and a `View` of `Figure`s, one per entity to draw.
"""

from typing import TYPE_CHECKING, Any

from client_sdk.async_client import AsyncClient
from client_sdk.client import Client
from client_sdk.events import (
    Answered,
    Corrected,
    Disconnected,
    Diverged,
    Event,
    EventsDropped,
    Happened,
    Joined,
    Left,
    Resumed,
    Resynchronised,
    SegmentLoaded,
)
from client_sdk.loopback import Loopback
from client_sdk.stats import Stats
from client_sdk.transports.connection import ConnectError
from client_sdk.view import Figure, View
from shared.inputs import Input, make_input

if TYPE_CHECKING:
    from client_sdk.netsim.links import Path

__all__ = [
    "Answered",
    "AsyncClient",
    "Client",
    "ConnectError",
    "Corrected",
    "Disconnected",
    "Diverged",
    "Event",
    "EventsDropped",
    "Figure",
    "Happened",
    "Input",
    "Joined",
    "Left",
    "Loopback",
    "Path",
    "Resumed",
    "Resynchronised",
    "SegmentLoaded",
    "Stats",
    "View",
    "make_input",
]


def __getattr__(name: str) -> Any:
    """Loads the simulator of links when a program asks for `Path`, and not before."""
    if name == "Path":
        from client_sdk.netsim.links import Path

        return Path
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
