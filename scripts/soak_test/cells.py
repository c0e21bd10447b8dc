"""The blocks that the players of a soak test edit, and what each may be at the end."""

import random
from collections import Counter

from shared import messages
from shared.world import World

Cell = tuple[int, int, int]


class Cells:
    """The kinds that each edited block may have: the last confirmed one, and all that were requested after it."""

    def __init__(self) -> None:
        self.asked: dict[Cell, list[int | None]] = {}
        """Kinds that each block may have. None stands for the kind in the terrain."""
        self.owner: dict[Cell, int] = {}
        self.verdicts: Counter[int] = Counter()
        self.settled: set[Cell] = set()
        """Blocks with a confirmed edit."""

    def ask(self, player: int, cell: Cell, rng: random.Random) -> int | None:
        """Returns a kind to request that no open edit of the block has; None if another player owns the block."""
        if self.owner.setdefault(cell, player) != player:
            return None
        kinds = self.asked.setdefault(cell, [None])
        kind = rng.choice([kind for kind in range(256) if kind not in kinds])
        kinds.append(kind)
        return kind

    def answered(self, cell: Cell, kind: int, verdict: int) -> None:
        """Takes the server's answer to the edit that requested `kind`."""
        self.verdicts[verdict] += 1
        kinds = self.asked[cell]
        if verdict == messages.DONE:
            self.settled.add(cell)
            del kinds[: kinds.index(kind)]
        else:
            kinds.remove(kind)

    def lost(self, world: World, untouched: World) -> list[str]:
        """Returns a text for each block whose kind is none of those that it may have.

        Args:
            world: the saved world.
            untouched: the world before all edits.
        """
        found = []
        for cell, kinds in self.asked.items():
            kind = world.blocks.get(*cell)
            if kind not in [untouched.blocks.get(*cell) if each is None else each for each in kinds]:
                found.append(f"block {cell} is {kind}; could be {kinds}")
        return found
