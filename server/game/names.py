"""The names of players: cleaned, or unique, as the rules ask for (`server.rules.Rules.names`)."""

import unicodedata
from collections.abc import Collection
from itertools import count

NAMELESS = "Player"
"""Name of a player of whose own name nothing is left."""
MARKS_MAX = 2
"""Maximum number of combining marks on a character."""
HIDDEN = frozenset(("Cc", "Cf", "Cn", "Co", "Cs"))
"""Unicode categories of characters that are removed: controls, marks of direction, characters without a sign."""
BLANKS = "\u115f\u1160\u2800\u3164\uffa0"
"""Letters that are drawn as a blank."""


def named(wanted: str, rule: str, taken: Collection[str], longest: int) -> str:
    """Returns the name of a new player.

    Args:
        wanted: the name that the client gave.
        rule: one of `server.rules.NAMES`.
        taken: the names of the other players.
        longest: maximum length in characters.
    """
    if rule == "any":
        return wanted
    name = cleaned(wanted, longest)
    return name if rule == "clean" else unique(name, taken, longest)


def cleaned(name: str, longest: int) -> str:
    """Returns a name in Unicode's form NFKC, without hidden characters, with single spaces between words."""
    kept: list[str] = []
    marks = 0
    for character in unicodedata.normalize("NFKC", name):
        kind = unicodedata.category(character)
        marks = marks + 1 if kind in ("Mn", "Me") else 0
        if character.isspace() or character in BLANKS:
            kept.append(" ")
        elif kind not in HIDDEN and marks <= MARKS_MAX:
            kept.append(character)
    return " ".join("".join(kept).split())[:longest].rstrip() or NAMELESS[:longest]


def unique(name: str, taken: Collection[str], longest: int) -> str:
    """Returns a name, with a number behind it if another player has the name, in capitals or not."""
    others = {other.casefold() for other in taken}
    if name.casefold() not in others:
        return name
    for number in count(2):
        tail = f" {number}"
        other = name[: max(longest - len(tail), 0)].rstrip() + tail
        if other.casefold() not in others:
            return other
    raise AssertionError("a number is free")
