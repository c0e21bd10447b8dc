"""What a game keeps beside its world, so that it goes on after a restart: who plays, and what the rules have said.

It is noted as it happens (`RecordedWorld.note`), and whole with every checkpoint:

    ["player", entity, name, subject, tokens]    has joined or come back; of tokens, the digests
    ["answered", entity, number, verdict]        a command of that player
    ["settled", entity, verdicts]                the latest of them by number: with a checkpoint
    ["left", entity]
    ["said", entity, attributes]                 all of them
    ["shared", values]                           all of them

What rules remember in their own variables is not kept: what must survive belongs into attributes and shared values.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from server.players.player import Player

PLAYER, ANSWERED, SETTLED, LEFT, SAID, SHARED = "player", "answered", "settled", "left", "said", "shared"


class Kept(NamedTuple):
    """What is kept, by entity where it is about one."""

    players: dict[int, Player]
    attributes: dict[int, dict[str, Any]]
    shared: dict[str, Any]


def note_of(player: Player) -> list[Any]:
    """The note of a player who has joined or come back."""
    return [PLAYER, player.entity, player.name, player.subject, player.tokens]


def whole(kept: Kept) -> list[list[Any]]:
    """All of it, as the notes that would lead to it."""
    notes = [note_of(player) for player in kept.players.values()]
    notes += [[SETTLED, entity, player.settled] for entity, player in kept.players.items() if player.settled]
    notes += [[SAID, entity, attributes] for entity, attributes in kept.attributes.items()]
    return [*notes, [SHARED, kept.shared]]


def restored(notes: Iterable[list[Any]]) -> Kept:
    """What these notes, in order, come to."""
    kept = Kept({}, {}, {})
    shared: Mapping[str, Any] = {}
    for kind, *parts in notes:
        match kind, parts:
            case "player", (entity, name, subject, tokens):
                player = kept.players.setdefault(entity, Player(entity, name, subject))
                player.tokens = list(tokens)
            case "answered", (entity, number, verdict):
                kept.players[entity].settle(number, verdict)
            case "settled", (entity, verdicts):
                kept.players[entity].settled.update(verdicts)
            case "left", (entity,):
                kept.players.pop(entity, None)
                kept.attributes.pop(entity, None)
            case "said", (entity, attributes):
                kept.attributes[entity] = attributes
            case "shared", (shared,):
                pass
            case _:
                raise ValueError(f"{kind!r}: no such note")
    for player in kept.players.values():
        player.verdicts.clear()  # who asks is told, from `settled`
        player.command = max(player.settled, default=-1)
    kept.shared.update(shared)
    return kept
