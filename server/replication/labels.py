"""The labels of entities: their numbers and attributes as clients are sent them, encoded once for all clients."""

from array import array
from collections.abc import Collection, Iterable, Mapping
from itertools import accumulate
from typing import Any

from shared import messages
from shared.bulk import ID_BITS
from shared.checks import Cell

ATTRIBUTE_BYTES = 32 * 1024
"""Maximum bytes of attributes in one segment delta, so that no message gets too long. Others follow a tick later."""
FEW_ENTITIES, ENTITY_BYTES = 3, 9
"""Number of entities whose attributes always fit into `ATTRIBUTE_BYTES`, and bytes that count for the number of an
entity. The latter is more than a number takes, which bounds the length of the list, too."""
NONE = b"", 0, b""
"""Labels of a segment without entities."""


class Labels(dict[int, bytes]):
    """The number and the attributes of each entity, encoded when they are first used; empty: it has none.

    Args:
        attributes: the attributes by entity.
        named: entities that have had attributes, which a client may still know.
    """

    def __init__(self, attributes: Mapping[int, Mapping[str, Any]], named: Collection[int]) -> None:
        self._attributes, self._named = attributes, named
        self._fields: dict[Cell, tuple[bytes, int, bytes]] = {}
        """Keys of the entities of each segment, number of their labels, and the field with these."""

    def __missing__(self, entity: int) -> bytes:
        values = self._attributes.get(entity)
        label = b""
        if values is not None or entity in self._named:
            label = messages.pack(entity) + messages.pack(values or {})
        self[entity] = label
        return label

    def forget(self, entity: int) -> None:
        """Forgets the label of an entity that was removed, or whose attributes have changed."""
        if self.pop(entity, None) is not None:
            self._fields.clear()

    def of(self, entities: list[int]) -> tuple[bytes, list[int]]:
        """Returns the field `attributes` of entities, encoded, and the entities whose labels do not fit.

        The field is empty if they have none.
        """
        labels = list(filter(None, map(self.__getitem__, entities)))
        packed = b"".join(labels)
        if fit(len(labels), packed):
            return field(len(labels), packed), []
        named = [entity for entity in entities if self[entity]]
        numbers = map(len, map(messages.pack, named))
        sizes = (len(label) - number for label, number in zip(labels, numbers, strict=True))
        ends = accumulate(size + ENTITY_BYTES for size in sizes)
        fits = max(sum(end <= ATTRIBUTE_BYTES for end in ends), 1)
        return field(fits, b"".join(labels[:fits])), named[fits:]

    def of_segment(self, segment: Cell, keys: bytes) -> tuple[bytes, list[int]]:
        """Returns the result of `of` for all entities of a segment.

        Mostly the entities are those of the call before, or new ones have followed. This saves some 20 us of a join
        into a crowd of 200.

        Args:
            segment: the segment.
            keys: the keys of its entities (`snapshot.TickEncoder.rows_in`).
        """
        known, n, made = self._fields.get(segment, NONE)
        if keys == known:
            return made, []
        if not keys.startswith(known):
            known, n, made = NONE
        labels = list(filter(None, map(self.__getitem__, ids_of(keys[len(known) :]))))
        packed = made[len(field(n, b"")) :] + b"".join(labels)
        n += len(labels)
        if not fit(n, packed):
            return self.of(list(ids_of(keys)))
        made = field(n, packed)
        self._fields[segment] = keys, n, made
        return made, []


def keys_of(ids: Iterable[int]) -> bytes:
    """Returns keys of entities whose place in memory does not matter."""
    return array("q", (entity << ID_BITS for entity in ids)).tobytes()


def ids_of(keys: bytes) -> Iterable[int]:
    """Returns the ids of entities from their keys."""
    return (key >> ID_BITS for key in memoryview(keys).cast("q"))


def fit(n: int, packed: bytes) -> bool:
    """Returns whether `n` labels fit into a segment delta."""
    return n <= FEW_ENTITIES or len(packed) + ENTITY_BYTES * n <= ATTRIBUTE_BYTES


def field(n: int, packed: bytes) -> bytes:
    """Returns the field `attributes` with `n` labels; empty if there are none."""
    return messages.array_head(2 * n) + packed if n else b""
