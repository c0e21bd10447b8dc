"""Other entities, as the turn of a behaviour sees them."""

from dataclasses import dataclass

from shared.checks import Vec


@dataclass(frozen=True, slots=True)
class Seen:
    """Another entity as a turn sees it: as it was before all turns of the tick. Positions in blocks.

    The fields of its behaviour are attributes, too: `other.stamina`.
    """

    entity: int
    template: str
    position: Vec
    velocity: Vec
    fields: dict[str, int]
    """The fields of its behaviour by name; empty if it has none."""

    def __getattr__(self, name: str) -> int:
        if name not in self.fields:
            raise AttributeError(f"entity {self.entity}: a {self.template!r} has no field {name!r}")
        return self.fields[name]
