"""The fields of a behaviour as attributes of its bodies."""

from typing import Any

from shared.behaviours import BehaviourEntry, Field
from shared.body import Body


def body_class(entry: BehaviourEntry, first: int) -> type[Body]:
    """Returns the class of the bodies of a behaviour, with its fields as attributes.

    Args:
        entry: the behaviour.
        first: place of its first field among the extra columns.
    """
    names: dict[str, Any] = {"__slots__": ()}  # so that a turn that sets any other name fails
    for k, each in enumerate(entry.fields):
        names[each.name] = _attribute(each, first + k)
    return type(f"{entry.name}Body", (Body,), names)


def _attribute(declared: Field, column: int) -> property:
    """Returns the property by which a turn reads and sets a field."""
    low, high, bit = declared.low, declared.high, 1 << column

    def get(self: Body) -> int:
        return self._values[column]

    def put(self: Body, value: object) -> None:
        if type(value) is not int or not low <= value <= high:
            value = declared.checked(value)
        if value == self._values[column]:
            return
        self.changes = True
        self._values[column] = value
        self._parts.mask |= bit

    return property(get, put)
