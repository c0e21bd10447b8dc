"""The two worlds of a client, and how the one catches the other's mistakes.

Theory of operation. *Confirmed* is the server's world as of the newest snapshot, as far as this client sees it. It
is never stepped: what happens in it is told, and what goes on as it did goes on. *Predicted* is confirmed plus a
replay: stepped by the same function with the own inputs, while everybody else goes on with the latest input known of
them. For every predicted tick the states are kept. When the snapshot for tick T comes, it is compared with what was
predicted for T, `==` on every bit of every entity:

    equal     the prediction stands; nothing is done (nor where only those differ who are too far away to be met
              before the next replay: they are put right with it)
    not       predicted = confirmed, and the inputs for T+1 .. now are replayed

Edits are predicted as well: carried out at their tick by the rule that the server uses, and forgotten when it has
given its verdict, so that a replay undoes what was refused.

A difference in the own entity is a *correction* and is counted; one in others only is a *reprediction* (someone
pressed a key). No tolerance: the physics is exact, so a lone player is never corrected, whatever the network does.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from client_sdk.events import Corrected
from shared import edits, kernels
from shared.checks import Cell
from shared.edits import Edit
from shared.inputs import NEUTRAL, Input
from shared.layout import COLUMNS, FALLING, FLAGS, ID, Int64s, X
from shared.messages import REPEATS_MAX, ProtocolError, Snapshot
from shared.ring import Ring
from shared.scene import Scene
from shared.snapshot import ACTED, KEYFRAME, SegmentPart, checksum, decode_parts
from shared.units import BLOCK, BLOCK_SHIFT, SEGMENT, SEGMENT_SHIFT
from shared.world import World

HISTORY = 256
"""Ticks for which predictions and inputs are kept."""
FOLLOW_MAX = 64
"""After more ticks without a snapshot, everything is sent anew."""
MEET_BLOCKS = 12
"""Whoever is further away cannot be met before a replay, at the speeds that legs have."""
NEAR_BLOCKS = 5.0
"""An edit this near may explain a correction."""

NONDETERMINISM = "nondeterminism"
"""The cause that must never occur: both sides knew the same and computed something else."""

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Reconciled:
    """What a snapshot did to the prediction."""

    correction: Corrected | None
    repredicted: bool
    replayed: int
    offsets: dict[int, Place]
    """Where each predicted entity was, minus where it is now, in blocks."""
    acted: frozenset[int]
    """Entities that the server's rules have moved: their pictures jump."""


NOTHING = Reconciled(None, False, 0, {}, frozenset())


class Prediction:
    """Confirmed and predicted world of one client, for its entity.

    Args:
        neighbours: carry others on in the predicted world, too, so that blocking each other is predicted; else they
            are left out of it.
    """

    def __init__(self, scene: Scene, entity: int, *, neighbours: bool = True, compiled: bool | None = None) -> None:
        self.entity = entity
        self.neighbours = neighbours
        self.ahead = 0
        """Inputs are filed so many ticks ahead of the predicted world: the input delay."""
        self.confirmed = World(scene, compiled=compiled)
        self.predicted = World(scene, compiled=compiled)
        self.truth = self.confirmed.states()
        """The states of the confirmed world, [n, 12], ascending by id. Not to be written to."""
        self.attributes: dict[int, dict[str, Any]] = {}
        """What the game's rules say of the entities that are seen."""
        self.begun = False
        self._inputs: Ring[Input] = Ring(HISTORY)
        self._states: Ring[Int64s] = Ring(HISTORY)
        self._templates = len(scene.templates)
        self._shown_ahead = np.array([template.shown == "predicted" for template in scene.templates], np.int64)
        self._exist = frozenset(scene.segments())
        self._terrain_changed = self._edited_near = False
        self._acted: set[int] = set()
        self._edits: dict[int, tuple[int, Edit]] = {}  # by number, with its tick; until there is a verdict
        self._compared = -1
        self._early: dict[Cell, list[tuple[list[int], list[int]]]] = {}

    # -- the server's word ---------------------------------------------------------------------------------

    def expect_segment(self, segment: Cell) -> None:
        """The first piece of a segment has come: it was packed before any edit that comes from here on."""
        self._early[segment] = []

    def load_segment(self, segment: Cell, kinds: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> None:
        """The blocks of a segment have come."""
        self.confirmed.load_segment(segment, kinds)
        for offsets, changed in self._early.pop(segment, ()):
            self.confirmed.write_blocks(segment, offsets, changed)
        self._terrain_changed = True

    def settle(self, number: int, done: bool) -> None:
        """The server has given its verdict on an edit."""
        if self._edits.pop(number, None) is not None and not done:
            self._terrain_changed = True  # undo it

    def apply(self, snapshot: Snapshot) -> str:
        """Writes a snapshot into the confirmed world; what is wrong with the result, or nothing.

        Raises:
            ProtocolError: a part of it is malformed.
        """
        world = self.confirmed
        parts, states, turns = decode_parts(snapshot.segments, self._templates, compiled=world.compiled)
        ticks = snapshot.tick - world.tick
        wrong = ""
        if len(turns):
            if ticks != 1:
                raise ProtocolError("segment.heads: the tick before was not told")
            known = [entity in world for entity in turns[:, 0].tolist()]
            if not all(known):
                turns, wrong = turns[known], "entities are missing"
        here = set(states[:, ID].tolist())
        if max(states[:, FLAGS].tolist(), default=0) >= ACTED:
            self._acted.update(states[states[:, FLAGS] & ACTED != 0, ID].tolist())
            states[:, FLAGS] &= FALLING
        drops: set[Cell] = set()
        if snapshot.drops:
            drops = {(x, y, z) for x, y, z in np.frombuffer(snapshot.drops, "<i4").reshape(-1, 3).tolist()}
        world.follow(turns, min(ticks, FOLLOW_MAX))
        if drops or any(part.gone or part.ago == KEYFRAME for part in parts):
            self._take_away(parts, drops, here)
        for part in parts:
            if len(part.edits):
                changes = part.edits["block"].tolist(), part.edits["kind"].tolist()
                if part.segment in world.blocks:
                    world.write_blocks(part.segment, *changes)
                    self._terrain_changed = True
                    self._edited_near |= self._near(part.segment, part.edits["block"].astype(np.int64))
                if part.segment in self._early:
                    self._early[part.segment].append(changes)
        if here:
            world.put(states)
        for part in parts:
            if part.attributes:
                self.attributes.update((entity, said) for entity, said in part.attributes if entity in world)
        for segment in drops:
            self._early.pop(segment, None)
            if segment in world.blocks and not len(world.in_segment(segment)):
                world.unload_segment(segment)
                self._terrain_changed = True
        world.rebase(snapshot.tick)
        self.truth = world.states()
        for part in parts:
            if part.check and part.segment in world.blocks and checksum(world, part.segment) != part.check:
                return f"segment {part.segment} is not the server's"
        return wrong

    def _near(self, segment: Cell, offsets: Int64s) -> bool:
        """Whether one of these blocks is so near to the own entity that it may have met it."""
        if self.entity not in self.confirmed:
            return False
        inside = SEGMENT - 1
        blocks = (
            np.stack((offsets & inside, offsets >> 5 & inside, offsets >> 10), axis=1) + np.array(segment) * SEGMENT
        )
        ways = np.abs(blocks - np.array(self.confirmed.position(self.entity)))
        return bool((ways.max(axis=1) < NEAR_BLOCKS).any())

    def grounded(self) -> bool:
        """Whether the blocks of every segment that exists around the own entity are there."""
        place = self.confirmed.state(self.entity)[X : X + 3]
        x, y, z = (part >> (BLOCK_SHIFT + SEGMENT_SHIFT) for part in place)
        around = {(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
        return all(segment in self.confirmed.blocks for segment in around & self._exist)

    def _take_away(self, parts: list[SegmentPart], drops: set[Cell], here: set[int]) -> None:
        """Removes who is gone, or was in a segment that is not seen any more or sent whole, and is not `here`."""
        segments = (self.truth[:, X : X + 3] >> (BLOCK_SHIFT + SEGMENT_SHIFT)).tolist()
        whole = drops | {part.segment for part in parts if part.ago == KEYFRAME}
        gone = {(part.segment, entity) for part in parts for entity in part.gone}
        for entity, (x, y, z) in zip(self.truth[:, ID].tolist(), segments, strict=True):
            home = (x, y, z)
            if entity not in here and (home in whole or (home, entity) in gone):
                self.confirmed.remove(entity)
                self.attributes.pop(entity, None)

    # -- the guess -----------------------------------------------------------------------------------------

    def begin(self, tick: int) -> None:
        """(Re)starts the prediction at `tick` from the confirmed world, with the inputs that have been sent."""
        self._replay(tick)
        self.begun = True

    def adopt(self, old: "Prediction") -> None:
        """Goes on from where an earlier one of the same entity was: its inputs, and its edits without a verdict."""
        self._inputs, self._edits = old._inputs, old._edits

    def rows_since(self, tick: int, to: int) -> bytes:
        """The own inputs after `tick`, up to `to`, as `Inputs.rows`; what was left out is what would stand in."""
        return b"".join(bytes(part & 0xFF for part in self._wish(at)) for at in range(tick + 1, to + 1))

    def file(self, tick: int, wish: Input) -> None:
        """The own input for a tick to come."""
        self._inputs.put(tick, wish)

    def step(self) -> None:
        """Predicts one tick."""
        world = self.predicted
        tick = world.tick + 1
        for due, edit in self._edits.values():
            # One that is due but has no verdict yet is carried out as soon as the replay begins.
            if due == tick or (due < tick and tick == self.confirmed.tick + 1):
                edits.apply(world, self.entity, edit)
        world.step({self.entity: self._wish(tick)} if self.entity in world else None)
        self._states.put(tick, world.states())

    def _wish(self, tick: int) -> Input:
        """The own input of a tick; where none was sent, what the server puts in its place."""
        for before in range(tick, tick - REPEATS_MAX - 1, -1):
            wish = self._inputs.get(before)
            if wish is not None:
                return wish
        return NEUTRAL

    @property
    def next_order(self) -> int:
        """The next tick that has no input yet: what is ordered now is done then."""
        return self.predicted.tick + self.ahead + 1

    def edit(self, number: int, edit: Edit) -> int:
        """Files an edit for the next tick that has no input yet; that tick."""
        self._edits[number] = (self.next_order, edit)
        return self.next_order

    def reconcile(self, late: bool) -> Reconciled:
        """Compares the newest confirmed tick with what was predicted for it, and replays if they differ.

        `late`: an input up to that tick, and after the one before, was late or missing at the server.
        """
        tick = self.confirmed.tick
        if tick == self._compared:
            return NOTHING
        skipped = tick - self._compared > 1
        self._compared = tick
        acted, self._acted = frozenset(self._acted), set()
        if not self.begun:
            return NOTHING
        if tick > self.predicted.tick:  # overtaken: nothing was predicted for this tick
            self._replay(tick)
            return NOTHING
        guess, truth = self._states.get(tick), self._truth()
        if guess is not None and not self._terrain_changed and self._near_equal(guess, truth):
            return NOTHING
        correction = None
        if guess is not None and (mine := self._difference(guess, truth)):
            others = len(self.confirmed) > 1
            causes = (
                (late, "late input"),
                (self.entity in acted, "server act"),
                (self._edited_near, "unknown edit"),
                (others and (skipped or not self.neighbours), "other entity"),
                (others and self._others_differ(guess, truth), "other entity"),
                (not self.grounded(), "missing terrain"),
            )
            cause = next((cause for holds, cause in causes if holds), NONDETERMINISM)
            correction = Corrected(tick, *mine, self.predicted.tick - tick, cause)
        before, now = self.predicted.states(), self.predicted.tick
        self._replay(now)
        return Reconciled(correction, correction is None, now - tick, _offsets(before, self.predicted.states()), acted)

    def state_before(self, entity: int) -> tuple[int, ...] | None:
        """The state of an entity one tick before the newest predicted one."""
        states = self._states.get(self.predicted.tick - 1)
        if states is None:
            return None
        mine = states[states[:, ID] == entity]
        return tuple(mine[0].tolist()) if len(mine) else None

    def rehearse(self) -> None:
        """Goes back to the confirmed world and replays all since: the sync test. Changes nothing, if all is well."""
        self._replay(self.predicted.tick)

    def _truth(self) -> Int64s:
        return self.truth if self.neighbours else self.truth[self.truth[:, ID] == self.entity]

    def _replay(self, to: int) -> None:
        self.predicted.restore(self.confirmed)
        self._terrain_changed = self._edited_near = False
        if not self.neighbours:
            for entity in self.predicted.states()[:, ID].tolist():
                if entity != self.entity:
                    self.predicted.remove(entity)
        while self.predicted.tick < to:
            self.step()

    def _near_equal(self, guess: Int64s, truth: Int64s) -> bool:
        """Whether all that could meet the own entity, or is drawn as predicted, is as predicted."""
        if guess.tobytes() == truth.tobytes():
            return True
        compiled = self.confirmed.compiled
        kernel = kernels.compiled() if compiled else kernels.PLAIN
        a, b, always = (kernels.lent(array, compiled) for array in (guess, truth, self._shown_ahead))
        return bool(kernel.alike(a, len(guess), b, len(truth), self.entity, MEET_BLOCKS * BLOCK, always))

    def _difference(self, guess: Int64s, truth: Int64s) -> tuple[tuple[str, ...], float] | None:
        """In which fields, and by how many blocks, the own entity is not as predicted."""
        was, mine = guess[guess[:, ID] == self.entity], truth[truth[:, ID] == self.entity]
        if not len(mine) or not len(was) or np.array_equal(mine, was):
            return None
        way = (mine[0, X : X + 3] - was[0, X : X + 3]) / BLOCK
        return tuple(COLUMNS[k] for k in np.flatnonzero(mine[0] != was[0])), float(np.sqrt((way * way).sum()))

    def _others_differ(self, guess: Int64s, truth: Int64s) -> bool:
        return not np.array_equal(guess[guess[:, ID] != self.entity], truth[truth[:, ID] != self.entity])


def _offsets(before: Int64s, after: Int64s) -> dict[int, Place]:
    """How far each entity that is in both has jumped back, in blocks."""
    was = dict(zip(before[:, ID].tolist(), before[:, X : X + 3].tolist(), strict=True))
    offsets: dict[int, Place] = {}
    for entity, place in zip(after[:, ID].tolist(), after[:, X : X + 3].tolist(), strict=True):
        old = was.get(entity, place)
        if old != place:
            x, y, z = ((a - b) / BLOCK for a, b in zip(old, place, strict=True))
            offsets[entity] = (x, y, z)
    return offsets
