"""The persisted state: what belongs to a game beside its world and survives a restart.

It consists of players, attributes and shared values. Each change is noted (`RecordedWorld.note`), and every checkpoint
has the whole state, as the notes that lead to it:

    ["player", entity, name, subject, tokens]    a player has joined or reconnected; digests of the resume tokens
    ["answered", entity, number, verdict]        a command of a player was carried out; a reason follows if there is one
    ["settled", entity, verdicts]                the latest verdicts by number; in checkpoints only
    ["reasons", entity, reasons]                 the reasons of refusals among them by number; in checkpoints only
    ["left", entity]                             an entity was removed, or its player has left
    ["said", entity, attributes]                 all attributes of an entity
    ["shared", values]                           all shared values
    ["entry", table, key, value]                 an entry of another table (`Entries`); nil: it was removed

Variables of the rules' class are not persisted. State that must survive belongs in attributes or shared values.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from server.players.player import Player
from shared.messages import Private, encode

PLAYER, ANSWERED, SETTLED, LEFT, ATTRIBUTES, SHARED = "player", "answered", "settled", "left", "said", "shared"
REASONS, ENTRY = "reasons", "entry"


@dataclass
class PersistedState:
    """The persisted state: players and attributes by entity, shared values by name, and further tables by their names.

    The keys of a further table are texts or whole numbers.
    """

    players: dict[int, Player] = field(default_factory=dict)
    attributes: dict[int, dict[str, Any]] = field(default_factory=dict)
    shared: dict[str, Any] = field(default_factory=dict)
    tables: dict[str, dict[Any, Any]] = field(default_factory=dict)

    def private_of(self, entity: int) -> bytes:
        """Returns the message with the values that only one player gets; empty if there have never been any."""
        known = self.tables.get("private", {}).get(entity)
        return b"" if known is None else encode(Private(known))


def note_of(player: Player) -> list[Any]:
    """Returns the note of a player who has joined or reconnected."""
    return [PLAYER, player.entity, player.name, player.subject, player.tokens]


def note_of_answer(entity: int, number: int, verdict: int, reason: str) -> list[Any]:
    """Returns the note of a command that was carried out; an empty reason is left out."""
    return [ANSWERED, entity, number, verdict, reason] if reason else [ANSWERED, entity, number, verdict]


def whole(kept: PersistedState) -> list[list[Any]]:
    """Returns the whole state as the notes that lead to it."""
    notes = [note_of(player) for player in kept.players.values()]
    notes += [[SETTLED, entity, player.settled] for entity, player in kept.players.items() if player.settled]
    notes += [[REASONS, entity, player.reasons] for entity, player in kept.players.items() if player.reasons]
    notes += [[ATTRIBUTES, entity, attributes] for entity, attributes in kept.attributes.items()]
    notes += [[ENTRY, name, *entry] for name, table in kept.tables.items() for entry in table.items()]
    return [*notes, [SHARED, kept.shared]]


def restored(notes: Iterable[list[Any]]) -> PersistedState:
    """Returns the state that notes, in order, lead to.

    Raises:
        ValueError: there is no such kind of note.
    """
    kept = PersistedState()
    for note in notes:
        take(kept, note)
    for player in kept.players.values():
        player.verdicts.clear()  # a client that asks again gets them from `settled`
        player.command = max(player.settled, default=-1)
    return kept


def take(kept: PersistedState, note: list[Any]) -> None:
    """Changes a state as a note says.

    Raises:
        ValueError: there is no such kind of note.
    """
    kind, *parts = note
    match kind, parts:
        case "player", (entity, name, subject, tokens):
            player = kept.players.setdefault(entity, Player(entity, name, subject))
            player.tokens = list(tokens)
        case "answered", (entity, number, verdict, *reason):
            kept.players[entity].settle(number, verdict, *reason)
        case "settled", (entity, verdicts):
            kept.players[entity].settled.update(verdicts)
        case "reasons", (entity, reasons):
            kept.players[entity].reasons.update(reasons)
        case "left", (entity,):
            kept.players.pop(entity, None)
            kept.attributes.pop(entity, None)
            kept.tables.get("private", {}).pop(entity, None)
        case "said", (entity, attributes):
            kept.attributes[entity] = attributes
        case "shared", (shared,):
            kept.shared.clear()
            kept.shared.update(shared)
        case "entry", (name, key, None):
            kept.tables.setdefault(name, {}).pop(key, None)
        case "entry", (name, key, value):
            kept.tables.setdefault(name, {})[key] = value
        case _:
            raise ValueError(f"{kind!r}: no such note")
