"""The two worlds of a client, and how the one catches the other's mistakes.

Theory of operation. *Confirmed* is the server's world as of the newest snapshot, as far as this client sees it
(`client_sdk.confirmed`). *Predicted* is confirmed plus a replay: stepped by the same function as the server's, with the
own inputs, while everybody else goes on with the latest input known of them. For every predicted tick the states are
kept. When the snapshot for tick T comes, it is compared with what was predicted for T, `==` on every bit of every
entity:

    equal     the prediction stands; nothing is done (nor where only those differ who are too far away to be met
              before the next replay: they are put right with it)
    not       predicted = confirmed, and the inputs for T+1 .. now are replayed

Edits are predicted as well: carried out at their tick by the rule that the server uses, and forgotten when it has
given its verdict, so that a replay undoes what was refused.

A difference in the own entity is a *correction* and is counted; one in others only is a *reprediction* (someone
pressed a key). No tolerance: the physics is exact, so a lone player is never corrected, whatever the network does.
"""

import math
from dataclasses import dataclass

import numpy as np

from client_sdk.confirmed import Confirmed
from client_sdk.events import Corrected
from shared import edits
from shared.bounds import bounds
from shared.edits import Edit
from shared.inputs import NEUTRAL, Input, row
from shared.layout import COLUMNS, ID, Int64s, X
from shared.ring import Ring
from shared.units import BLOCK
from shared.world import World

MEET_BLOCKS = 12
"""Whoever is further away cannot be met before a replay, at the speeds that legs have."""

NONDETERMINISM = "nondeterminism"
"""The cause that must never occur: both sides knew the same and computed something else."""

LOOK_BACK = 4
"""A drawn moment lies at most this many ticks after the kept state before it: snapshots may have been skipped."""

Place = tuple[float, float, float]
State = tuple[int, ...]


@dataclass(frozen=True)
class Reconciled:
    """What a snapshot did to the prediction."""

    correction: Corrected | None
    repredicted: bool
    replayed: int
    offsets: dict[int, Place]
    """Where each predicted entity was, minus where it is now, in blocks."""
    acted: frozenset[int]
    """Entities on which the server's rules have acted: their pictures jump."""
    placed: frozenset[int] = frozenset()
    """Entities that the server's rules have placed: nothing is left of an earlier correction, either."""


NOTHING = Reconciled(None, False, 0, {}, frozenset())


class Prediction:
    """Confirmed and predicted world of one client, for its entity.

    Args:
        known: the confirmed one, which snapshots go into.
        neighbours: carry others on in the predicted world, too, so that blocking each other is predicted; else they
            are left out of it.
    """

    def __init__(self, known: Confirmed, *, neighbours: bool = True) -> None:
        self.known = known
        self.entity = known.entity
        self.neighbours = neighbours
        self.ahead = 0
        """Inputs are filed so many ticks ahead of the predicted world: the input delay."""
        self.confirmed = known.world
        self.predicted = World(known.world.scene, compiled=known.world.compiled)
        self.attributes = known.attributes
        """What the game's rules say of the entities that are seen."""
        self.begun = False
        limits = bounds(known.world.scene.tick_rate)
        self._repeats = limits.repeats
        self._inputs: Ring[Input] = Ring(limits.predicted)
        self._states: Ring[Int64s] = Ring(limits.predicted)
        templates = known.world.scene.templates
        self._shown_ahead = np.array([template.shown == "predicted" for template in templates], np.int64)
        self._edits: dict[int, tuple[int, Edit]] = {}  # by number, with its tick; until there is a verdict
        self._refused = False  # an edit that was carried out in the last replay has been, since
        self._compared = -1

    def begin(self, tick: int) -> None:
        """(Re)starts the prediction at `tick` from the confirmed world, with the inputs that have been sent."""
        self._replay(tick)
        self.begun = True

    def adopt(self, old: "Prediction") -> None:
        """Goes on from where an earlier one of the same entity was: its inputs, and its edits without a verdict."""
        self._inputs, self._edits = old._inputs, old._edits

    def rows_since(self, tick: int, to: int) -> bytes:
        """The own inputs after `tick`, up to `to`, as `Inputs.rows`; what was left out is what would stand in."""
        return b"".join(row(self._wish(at)) for at in range(tick + 1, to + 1))

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
        for before in range(tick, tick - self._repeats - 1, -1):
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

    def settle(self, number: int, done: bool) -> None:
        """The server has given its verdict on an edit."""
        if self._edits.pop(number, None) is not None and not done:
            self._refused = True

    def reconcile(self, late: bool) -> Reconciled:
        """Compares the newest confirmed tick with what was predicted for it, and replays if they differ.

        `late`: an input up to that tick, and after the one before, was late or missing at the server.
        """
        known, tick = self.known, self.confirmed.tick
        if tick == self._compared:
            return NOTHING
        skipped = tick - self._compared > 1
        acted = known.take_acted()
        placed = self._placed(self._compared, tick)
        self._compared = tick
        if not self.begun:
            return NOTHING
        if tick > self.predicted.tick:  # overtaken: nothing was predicted for this tick
            self._replay(tick)
            return Reconciled(None, False, 0, {}, acted, placed) if placed else NOTHING
        guess, truth = self._states.get(tick), self._truth()
        changed = known.terrain_changed or self._refused
        if guess is not None and not changed and self._near_equal(guess, truth):
            return NOTHING
        correction = None
        if guess is not None and (mine := self._difference(guess, truth)):
            others = len(self.confirmed) > 1
            causes = (
                (late, "late input"),
                (self.entity in acted, "server act"),
                (known.edited_near, "unknown edit"),
                (others and (skipped or not self.neighbours), "other entity"),
                (others and self._others_differ(guess, truth), "other entity"),
                (not known.grounded(), "missing terrain"),
            )
            cause = next((cause for holds, cause in causes if holds), NONDETERMINISM)
            correction = Corrected(tick, *mine, self.predicted.tick - tick, cause)
        before, now = self.predicted.states(), self.predicted.tick
        self._replay(now)
        offsets = _offsets(before, self.predicted.states())
        return Reconciled(correction, correction is None, now - tick, offsets, acted, placed)

    def around(self, entity: int, at: float) -> tuple[State, State, float]:
        """Finds what to draw of an entity at a moment up to the newest predicted tick.

        Returns:
            Its states before and after the moment, and the share of the way between them that lies behind it. The two
            are the same one where it stands: until the snapshot of the tick in which it was placed, or where nothing
            older is kept.

        Raises:
            KeyError: it is not predicted.
        """
        newest = self.predicted.tick
        tick = min(math.floor(at), newest - 1)
        last, after = newest, self.predicted.state(entity)
        for later in range(max(tick + 1, newest - self._states.size), newest):
            if (state := self._state(entity, later)) is not None:
                last, after = later, state
                break
        for first in range(tick, tick - LOOK_BACK, -1):
            if (before := self._state(entity, first)) is not None:
                if entity in self._placed(first, last):
                    return before, before, 0.0
                return before, after, min(max((at - first) / (last - first), 0.0), 1.0)
        return after, after, 0.0

    def _placed(self, since: int, to: int) -> frozenset[int]:
        """The entities that the server's rules placed after the tick `since` and up to `to`."""
        ticks = range(max(since, to - self.known.follow_max) + 1, to + 1)
        return frozenset().union(*(ids for tick in ticks if (ids := self.known.placed.get(tick))))

    def _state(self, entity: int, tick: int) -> State | None:
        """The kept state of an entity at the end of a tick."""
        states = self._states.get(tick)
        if states is None:
            return None
        mine = states[states[:, ID] == entity]
        return tuple(mine[0].tolist()) if len(mine) else None

    def rehearse(self) -> None:
        """Goes back to the confirmed world and replays all since: the sync test. Changes nothing, if all is well."""
        self._replay(self.predicted.tick)

    def _truth(self) -> Int64s:
        states = self.known.states
        return states if self.neighbours else states[states[:, ID] == self.entity]

    def _replay(self, to: int) -> None:
        self.predicted.restore(self.confirmed)
        self.known.terrain_changed = self.known.edited_near = self._refused = False
        if not self.neighbours:
            for entity in self.predicted.states()[:, ID].tolist():
                if entity != self.entity:
                    self.predicted.remove(entity)
        self._states.put(self.confirmed.tick, self._truth())
        while self.predicted.tick < to:
            self.step()

    def _near_equal(self, guess: Int64s, truth: Int64s) -> bool:
        """Whether all that could meet the own entity, or is drawn as predicted, is as predicted."""
        if guess.tobytes() == truth.tobytes():
            return True
        kernel, reach = self.confirmed.kernel, MEET_BLOCKS * BLOCK
        a, b, always = map(kernel.lent, (guess, truth, self._shown_ahead))
        return bool(kernel.alike(a, len(guess), b, len(truth), self.entity, reach, always))

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
