"""The changes that the turn of a behaviour asks for; they are made after the last turn of the tick."""

from shared.edits import Edit
from shared.inputs import Input


class Changes:
    """The changes of one turn.

    Attributes:
        state: the new state, 12 columns; None: it stays.
        values: the extra columns.
        mask: bits of the extra columns that were set.
        steered: the input that replaces the player's; None: there is none.
        edits: changes of blocks.
        spawned: states of new entities, with all columns.
        removed: entities to remove.
        announced: names and payloads of events.
    """

    def __init__(self) -> None:
        self.state: list[int] | None = None
        self.values: list[int] = []
        self.mask = 0
        self.steered: Input | None = None
        self.edits: list[Edit] = []
        self.spawned: list[list[int]] = []
        self.removed: list[int] = []
        self.announced: list[tuple[str, bytes]] = []
