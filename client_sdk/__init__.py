"""Play on a Sovereign Netcode server: prediction, reconciliation, interpolation.

    from client_sdk import Client, Joined, Left

`Client` is for a game's own loop, `AsyncClient` for asyncio, `Loopback` for a server within the program. They return
events (`client_sdk.events`), and a `View` of `EntityView`s, one per entity to draw.
"""

from typing import TYPE_CHECKING, Any

from client_sdk.async_client import AsyncClient
from client_sdk.client import Client
from client_sdk.events import (
    Announced,
    Answered,
    BehaviourFailed,
    Corrected,
    Disconnected,
    Diverged,
    Event,
    EventsDropped,
    Happened,
    Joined,
    Left,
    Matched,
    Moved,
    Resumed,
    Resynchronised,
    SegmentLoaded,
    Waiting,
    Withdrawn,
)
from client_sdk.loopback import Loopback
from client_sdk.stats import Stats
from client_sdk.transports.connection import ConnectError
from client_sdk.transports.listing import WorldEntry, list_worlds
from client_sdk.view import EntityView, View
from shared.inputs import Input, make_input

if TYPE_CHECKING:
    from client_sdk.netsim.links import Link

__all__ = [
    "Announced",
    "Answered",
    "AsyncClient",
    "BehaviourFailed",
    "Client",
    "ConnectError",
    "Corrected",
    "Disconnected",
    "Diverged",
    "EntityView",
    "Event",
    "EventsDropped",
    "Happened",
    "Input",
    "Joined",
    "Left",
    "Link",
    "Loopback",
    "Matched",
    "Moved",
    "Resumed",
    "Resynchronised",
    "SegmentLoaded",
    "Stats",
    "View",
    "Waiting",
    "Withdrawn",
    "WorldEntry",
    "list_worlds",
    "make_input",
]

RENAMED = {"Figure": "EntityView", "Path": "Link"}
"""Names of version 0.1, which still work in 0.2, and the new ones (docs/renamed.md)."""


def __getattr__(name: str) -> Any:
    """Loads the simulator of links when a program asks for `Link`, and knows the old names of `RENAMED`."""
    known = RENAMED.get(name, name)
    if known == "Link":
        from client_sdk.netsim.links import Link

        return Link
    if name in RENAMED:
        return globals()[known]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
