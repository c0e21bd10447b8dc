"""The outcome of a tick: what the rules did in it, apart from the changes of the world itself.

Theory of operation. A tick has two halves. The sequencer half changes the world. The edge half serves the clients, on
the same world or on a replica of it. The outcome is all that the edge half needs besides that world and the persisted
state: the sequencer half fills it during a tick, and the edge half empties it.
"""

from dataclasses import dataclass, field


@dataclass
class Outcome:
    """The outcome of the present tick. Players are given by the numbers of their entities."""

    acted: set[int] = field(default_factory=set)
    """Entities that the rules changed, apart from placed ones, which the world notes (`WorldState.placed`)."""
    attributes: set[int] = field(default_factory=set)
    """Entities whose attributes changed."""
    removed: list[int] = field(default_factory=list)
    """Entities that were removed, in order."""
    private: set[int] = field(default_factory=set)
    """Players whose private values changed."""
    verdicts: list[tuple[int, int, int, str]] = field(default_factory=list)
    """Verdicts of commands in order: player, number, verdict, and the reason of a refusal; empty: none."""
    events: list[tuple[frozenset[int] | None, bytes]] = field(default_factory=list)
    """Game events in order: the players to send it to (None: all), and the message."""
    announced: list[tuple[int, str, bytes]] = field(default_factory=list)
    """Announcements of behaviours in order: entity, name, payload."""

    def clear(self) -> None:
        """Empties the outcome for the next tick."""
        self.acted.clear()
        self.attributes.clear()
        self.removed.clear()
        self.private.clear()
        self.verdicts.clear()
        self.events.clear()
        self.announced.clear()
