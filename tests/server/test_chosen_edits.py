"""Edits chosen so that the former digest stays the same: each of them counts wherever worlds are compared."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from server.journal import former
from server.observability.live import Relief
from server.persistence.checkpoint import Copy, generated, restored, saved_of
from server.replication.change_log import ChangeLog
from shared import messages
from shared.blocks import offset_of
from shared.edits import Edit
from shared.messages import Snapshot
from shared.snapshot import VERDICT, checksum
from shared.world import World
from tests.patience import until
from tests.server.test_persisted_state import Stored
from tests.server.test_store import copied
from tests.tables import order
from tests.worlds import build, floor

CELL = (0, 0, 0)
MANY = 40


def collision(cells: Iterable[tuple[int, int, int]], n: int) -> list[Edit]:
    """Returns exactly `n` edits of air blocks in segment (0, 0, 0) that leave its former digest unchanged.

    The digest of a segment was the exclusive-or of one part per block, which depends only on the block's place and
    kind. So the edits solve a system of 64 linear equations over bits: of any 65 parts, some cancel out.
    """
    places = list(cells)
    for kind in range(1, 256):
        edits = [Edit(x, y, z, kind) for x, y, z in places]
        basis: dict[int, tuple[int, int]] = {}  # by the highest bit: a sum of parts, and the set of its parts as bits
        for number, edit in enumerate(edits):
            kinds = np.zeros(32768, np.uint8)
            kinds[offset_of(*edit[:3])] = kind
            part, whose = former.digest_of(kinds), 1 << number
            while part and part.bit_length() in basis:
                other, others = basis[part.bit_length()]
                part, whose = part ^ other, whose ^ others
            if part:
                basis[part.bit_length()] = part, whose
            elif whose.bit_count() == n:
                return [edit for i, edit in enumerate(edits) if whose >> i & 1]
    raise AssertionError("none found")


def air(radius: int) -> list[tuple[int, int, int]]:
    """Returns blocks above a floor at z = 0, within reach of (16, 16), without the column itself and those beside
    it."""
    span = range(16 - radius, 17 + radius)
    return [(x, y, z) for z in range(2, 5) for y in span for x in span if max(abs(x - 16), abs(y - 16)) > 1]


CHOSEN = collision(air(3), MANY)


def edited(world: World) -> World:
    for edit in CHOSEN:
        world.set_block(*edit)
    return world


def test_the_edits_are_well_chosen() -> None:
    world = build([floor(0)])
    before = former.state_hash(world)
    edited(world)
    assert len({edit[:3] for edit in CHOSEN}) == MANY
    assert former.state_hash(world) == before


def test_every_comparison_of_worlds_finds_these_edits() -> None:
    world = build([floor(0)])
    log, relief, copy = ChangeLog(world), Relief(world), world.copy()

    def marks() -> tuple[object, ...]:
        return (
            world.state_hash(), world.blocks.digest(CELL), world.blocks.version(CELL), checksum(world, CELL),
            log.packed(CELL), relief.versions(),
        )  # fmt: skip

    before = marks()
    edited(world)
    after = marks()
    assert [a != b for a, b in zip(before, after, strict=True)] == [True] * len(before)
    copy.restore(world)
    assert copy.state_hash() == world.state_hash()
    assert all(copy.blocks.get(*edit[:3]) == edit.kind for edit in CHOSEN)


def test_a_checkpoint_holds_every_touched_segment() -> None:
    world, _ = generated(build([floor(0)]).scene, compiled=False)
    saved = saved_of(world)
    edited(world)
    *_, checkpoint = Copy(world, b"\xc0").pieces(saved)
    assert checkpoint is not None
    assert [segment[:3] for segment in checkpoint.segments] == [CELL]
    *_, whole = Copy(world, b"\xc0").pieces({})
    assert whole is not None
    again = restored(world.scene, whole, compiled=False)
    assert all(again.blocks.get(*edit[:3]) == edit.kind for edit in CHOSEN)


@pytest.mark.parametrize("restart", ["crash", "stop"])
def test_answered_edits_are_there_after_a_checkpoint_and_a_restart(tmp_path: Path, restart: str) -> None:
    table = Stored(tmp_path / "data")
    link = table.join()
    table.tick(64)  # a player who has just joined may not edit yet
    for number, edit in enumerate(CHOSEN):
        link.say(order(number, table.tick_number + 1, *edit))
        table.tick(16)
    verdicts = b"".join(snapshot.verdicts for snapshot in link.got(Snapshot))
    assert [verdict for _, verdict in VERDICT.iter_unpack(verdicts)] == [messages.DONE] * MANY
    table.store._copy_due = True
    table.tick()
    until(lambda: table.store.checkpoint_s.count == 1)
    table.tick()
    directory = copied(tmp_path / "data", tmp_path / "copy") if restart == "crash" else tmp_path / "data"
    table.stop()
    again = Stored(directory)
    assert [again.game.world.blocks.get(*edit[:3]) for edit in CHOSEN] == [edit.kind for edit in CHOSEN]
    again.stop()
