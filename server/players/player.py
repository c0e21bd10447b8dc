"""A player: stays while its entity stays, whatever becomes of the connection."""

import math
from collections import deque
from typing import TYPE_CHECKING

from server.players.input_queue import DEFAULT, InputQueue
from server.players.outbox import Outbox
from shared.bounds import Bounds
from shared.messages import Command

if TYPE_CHECKING:
    from server.game.session import Session

SETTLED_MAX = 128
"""Verdicts of commands that are kept for a client that was cut off before it received them."""


class Player:
    """Somebody who plays: stays while the entity stays, whatever becomes of the connection.

    Args:
        entity: the player's own.
        name: what it calls itself.
        subject: whose token it showed; empty where none is asked for.
        bounds: those of the scene's tick rate.
    """

    def __init__(self, entity: int, name: str = "", subject: str = "", bounds: Bounds = DEFAULT) -> None:
        self.entity = entity
        self.name = name
        self.subject = subject
        self.announced = True
        """Whether the rules have been told of the join."""
        self.inputs = InputQueue(bounds)
        self.commands: deque[Command] = deque()
        """Those that wait for their tick."""
        self.command = -1
        """The highest number of a command so far."""
        self.verdicts: list[tuple[int, int]] = []
        """Number and verdict of commands, to be told."""
        self.settled: dict[int, int] = {}
        """The latest verdicts: who was cut off before hearing one asks again, and is told the same."""
        self.edits_left = math.inf
        self.tokens: list[bytes] = []
        """Digests of the tokens with which to come back: the newest, and the one before until that has been heard."""
        self.away_until = math.inf
        """While there is no connection: when the entity goes."""
        self.session: Session | None = None
        self.outbox = Outbox()
        """What the rules have sent, to be told."""

    def __repr__(self) -> str:
        return f"<Player {self.name!r}, entity {self.entity}>"

    def heard(self) -> None:
        """The client has got its newest token: it may throw away the one before, and so is that one worth nothing."""
        del self.tokens[:-1]

    def settle(self, number: int, verdict: int) -> None:
        """A command has been carried out, or not."""
        self.verdicts.append((number, verdict))
        self.settled[number] = verdict
        if len(self.settled) > SETTLED_MAX:
            del self.settled[next(iter(self.settled))]
