"""Play on a Sovereign Netcode server: prediction, reconciliation, interpolation.

    from client_sdk import Client, Joined, Left

`Client` is for a game's own loop, `AsyncClient` for asyncio, `Loopback` for a server within the program. They return
events (`client_sdk.events`), and a `View` of `EntityView`s, one per entity to draw.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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
    from client_sdk.netsim.links import Link
    from client_sdk.stats import Stats
    from client_sdk.transports.common import ConnectError
    from client_sdk.transports.listing import WorldEntry, list_worlds
    from client_sdk.view import EntityView, View
    from shared.inputs import Input, make_input

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

ELSEWHERE = {
    "AsyncClient": "async_client", "Client": "client", "ConnectError": "transports.common", "EntityView": "view",
    "Link": "netsim.links", "Loopback": "loopback", "Stats": "stats", "View": "view",
    "WorldEntry": "transports.listing", "list_worlds": "transports.listing",
}  # fmt: skip
"""Modules of the names that are not in `client_sdk.events`."""
RENAMED = {"Figure": "EntityView", "Path": "Link"}
"""Names of version 0.1, which still work in 0.2, and the new ones (docs/renamed.md)."""


def __getattr__(name: str) -> Any:
    """Loads the module of a name when a program asks for it, so that an import of this package loads nothing.

    It knows the old names of `RENAMED`, too.
    """
    known = RENAMED.get(name, name)
    if known not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if known in ("Input", "make_input"):
        from shared import inputs

        found = getattr(inputs, known)
    else:
        found = getattr(import_module(f"{__name__}.{ELSEWHERE.get(known, 'events')}"), known)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
