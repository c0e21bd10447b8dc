"""Prediction and reconciliation: the confirmed and the predicted world of a client.

Theory of operation. The *confirmed* world is the server's world as of the newest snapshot, as far as this client sees
it (`client_sdk.prediction.confirmed`). The *predicted* world is the confirmed one plus a replay: the function that
steps the server's world steps it with the own inputs, while other entities go on with their latest known inputs. The
states of every predicted tick are kept. When the snapshot for tick T arrives, it is compared with the prediction for T,
bit by bit for every entity:

    equal       the prediction stays, and nothing is done. This also holds if only entities differ that are too far
                away to be met before the next replay, and are not drawn as predicted; that replay corrects them.
    different   predicted = confirmed, and the inputs for T+1 .. now are replayed

Edits are predicted, too: they are applied at their tick by the rule that the server uses, and forgotten when the
server's verdict arrives. So a replay undoes an edit that was refused.

A difference in the own entity is a *correction*; one in other entities only is a *reprediction* (another player pressed
a key, for example). Both are counted. There is no tolerance: the physics is exact, so a player who meets no others is
never corrected as long as inputs arrive in time.
"""

import math
from dataclasses import dataclass

from client_sdk.controls import Controls
from client_sdk.events import Corrected
from client_sdk.prediction.announcements import Announcements
from client_sdk.prediction.comparison import Comparison, State, row_in
from client_sdk.prediction.confirmed import Confirmed
from shared import edits
from shared.bounds import bounds
from shared.checks import Vec
from shared.edits import Edit
from shared.inputs import NEUTRAL, Input, row
from shared.layout import CELL, ID, Int64s
from shared.ring import Ring
from shared.turns import Failure, Turns
from shared.world import World

NONDETERMINISM = "nondeterminism"
"""Cause of a correction that must never occur: both sides knew the same and computed different results."""

LOOK_BACK = 4
"""Number of ticks to search back for a kept state before a drawn moment; skipped snapshots leave gaps."""


@dataclass(frozen=True)
class Reconciled:
    """The result of comparing a snapshot with the prediction; `replayed` is the number of replayed ticks."""

    correction: Corrected | None
    repredicted: bool
    replayed: int
    offsets: dict[int, Vec]
    """Old minus new position of each entity that may be drawn as predicted and that the replay moved, in blocks."""
    acted: frozenset[int]
    """Entities on which the server's rules have acted: they are drawn at their new place at once."""
    placed: frozenset[int] = frozenset()
    """Entities that the server's rules have placed: the smoothing of earlier corrections ends, too."""


NOTHING = Reconciled(None, False, 0, {}, frozenset())
"""The result if nothing was replayed and no entity was placed."""


class Prediction:
    """The confirmed and the predicted world of one client.

    Args:
        confirmed_copy: the confirmed copy, which snapshots write.
        controls: where the input delay is set.
        neighbours: whether the predicted world has other entities, so that blocking each other is predicted; otherwise
            it has the own entity only.
    """

    def __init__(self, confirmed_copy: Confirmed, controls: Controls | None = None, *, neighbours: bool = True) -> None:
        self.confirmed_copy = confirmed_copy
        self.entity = confirmed_copy.entity
        self.neighbours = neighbours
        scene = confirmed_copy.world.scene
        self._comparison = Comparison(confirmed_copy.world, self.entity)
        self.last_own = self._comparison.last_own
        self._controls = controls or Controls()
        self.confirmed = confirmed_copy.world
        self.predicted = World(scene, compiled=confirmed_copy.world.compiled)
        self.attributes = confirmed_copy.attributes
        """Attributes of the entities that the client sees, by entity and name."""
        self.begun = False
        self._rate = scene.tick_rate
        limits = self._bounds = bounds(scene.tick_rate)
        self._inputs: Ring[Input] = Ring(limits.predicted)
        self._states: Ring[Int64s] = Ring(limits.predicted)
        self.announcements = Announcements(scene.tick_rate)
        """The announcements of the own entity, for the program."""
        self.failures: list[Failure] = []
        """Turns of behaviours that have failed in a tick that was predicted for the first time."""
        self._edits: dict[int, tuple[int, Edit]] = {}  # edits without a verdict, with their ticks, by number
        self._refused = False  # whether an edit that the last replay applied was refused since
        self._compared = -1
        self._row = 0  # row of the entity that `_state` was asked for last
        self._failed: set[tuple[int, int]] = set()  # ticks and entities of failed turns that the program knows
        self._acts_differ = False  # whether the server did other acts since the last replay than predicted

    def begin(self, tick: int) -> None:
        """Starts the prediction at `tick`, or starts it again: replays the filed inputs from the confirmed world."""
        self.replay(tick)
        self.begun = True

    def adopt(self, old: "Prediction") -> None:
        """Takes over the inputs and the edits without a verdict from an earlier prediction of the same entity."""
        self._inputs, self._edits, self.announcements = old._inputs, old._edits, old.announcements
        self._failed = old._failed

    def take_place(self, old: "Prediction") -> None:
        """Goes on from another prediction of the same entity in the same world, without a replay.

        The next comparison is with the states that `old` has predicted. An edit that `old` knows to be done may not be
        in this confirmed world yet, so a replay now would lack it.
        """
        self.adopt(old)
        self._states, self.predicted, self.begun = old._states, old.predicted, True
        self._compared, self._refused = old._compared, old._refused
        self.confirmed_copy.take_acted()

    def rows_since(self, tick: int, to: int) -> bytes:
        """Returns the own inputs after `tick`, up to `to`, packed as `Inputs.rows`.

        For a tick without an input, the row is the substitute that the server would use.
        """
        aim = self.confirmed.scene.aim
        return b"".join(row(self._input(at), aim=aim) for at in range(tick + 1, to + 1))

    def file(self, tick: int, input_: Input) -> None:
        """Files the own input for a future tick."""
        self._inputs.put(tick, input_)

    def forget_inputs(self) -> None:
        """Forgets all filed inputs: `NEUTRAL` stands in for them, as at a server that has got no input."""
        self._inputs = Ring(self._bounds.predicted)

    def step(self) -> None:
        """Predicts one tick."""
        world = self.predicted
        tick = world.tick + 1
        for due, edit in self._edits.values():
            # An earlier edit without a verdict is not in the confirmed world: the first tick of a replay applies it.
            if due == tick or (due < tick and tick == self.confirmed.tick + 1):
                edits.apply(world, self.entity, edit)
        world.step({self.entity: self._input(tick)} if self.entity in world else None)
        self._states.put(tick, world.states())
        if world.turns is not None:
            self._heed(world.turns, tick)

    def _heed(self, turns: Turns, tick: int) -> None:
        """Takes the announcements and the exceptions of the turns of the latest step."""
        for event in turns.announced:
            if self.entity <= event.entity <= self.last_own:
                self.announcements.add(tick, event)
        for each in turns.take_failures() if turns.failures else ():
            if (each.tick, each.entity) not in self._failed:
                self._failed.add((each.tick, each.entity))
                self.failures.append(each)

    def _input(self, tick: int) -> Input:
        """Returns the own input of a tick, or the substitute that the server uses if none was sent."""
        missing = 0
        while self._bounds.stands_in(missing):
            if (input_ := self._inputs.get(tick - missing)) is not None:
                return input_
            missing += 1
        return NEUTRAL

    @property
    def ahead(self) -> int:
        """Input delay in ticks: inputs are filed this far ahead of the predicted world."""
        return self._controls.delay

    @property
    def next_order(self) -> int:
        """The next tick that has no input yet, at which a command or edit of now is carried out."""
        return self.predicted.tick + self.ahead + 1

    def edit(self, number: int, tick: int, edit: Edit) -> None:
        """Files an edit for a tick that has no input yet."""
        self._edits[number] = (tick, edit)

    def settle(self, number: int, done: bool) -> None:
        """Takes the server's verdict on an edit; one that was not `done` is undone by the next replay."""
        if self._edits.pop(number, None) is not None and not done:
            self._refused = True

    def reconcile(self, late: bool) -> Reconciled:
        """Compares the newest confirmed tick with the prediction for it, and replays if they differ.

        Args:
            late: whether the server lacked an input in time for a tick since the last comparison.
        """
        confirmed_copy, tick = self.confirmed_copy, self.confirmed.tick
        if tick == self._compared:
            return NOTHING
        skipped = tick - self._compared > 1
        acted = confirmed_copy.take_acted()
        placed = frozenset().union(*self._placed(self._compared, tick))
        self._compared = tick
        if not self.begun:
            return NOTHING
        if tick > self.predicted.tick:  # the snapshot overtook the prediction: nothing to compare
            self.replay(tick)
            return Reconciled(None, False, 0, {}, acted, placed) if placed else NOTHING
        predicted, confirmed = self._states.get(tick), self._confirmed_states()
        changed = confirmed_copy.terrain_changed or self._refused
        # An entity that cannot be met may be in the way of an edit.
        ahead_s = math.inf if self._edits else (self.predicted.tick - tick) / self._rate
        if predicted is not None and not changed and self._comparison.near_equal(predicted, confirmed, ahead_s):
            return NOTHING
        correction = None
        if predicted is not None and (mine := self._comparison.difference(predicted, confirmed)):
            others = len(self.confirmed) > 1
            causes = (
                (late, "late input"),
                (self.entity in acted, "server act"),
                (confirmed_copy.edited_near, "unknown edit"),
                (others and (skipped or not self.neighbours), "other entity"),
                (others and self._comparison.others_differ(predicted, confirmed), "other entity"),
                (not confirmed_copy.grounded(), "missing terrain"),
            )
            cause = next((cause for holds, cause in causes if holds), NONDETERMINISM)
            correction = Corrected(tick, *mine, self.predicted.tick - tick, cause)
        before, now = self.predicted.states(), self.predicted.tick
        self.replay(now)
        offsets = self._comparison.offsets(before, self.predicted.states())
        return Reconciled(correction, correction is None, now - tick, offsets, acted, placed)

    def around(self, entity: int, at: float) -> tuple[State, State, float]:
        """Returns the states to draw an entity between, at a moment up to the newest predicted tick.

        Args:
            entity: number of the entity.
            at: the moment, in ticks.

        Returns:
            The states before and after the moment, and the share of the way between them, 0 to 1. Both states are one
            and the same if the entity is drawn standing: before the tick in which the rules placed it, or if no
            earlier state is kept.

        Raises:
            KeyError: the entity is not predicted.
        """
        newest = self.predicted.tick
        tick = min(math.floor(at), newest - 1)
        for last in range(max(tick + 1, newest - self._states.size), newest):
            if (after := self._state(entity, last)) is not None:
                break
        else:
            last, after = newest, self.predicted.state(entity)
        for first in range(tick, tick - LOOK_BACK, -1):
            if (before := self._state(entity, first)) is not None:
                if any(entity in placed for placed in self._placed(first, last)):
                    return before, before, 0.0
                return before, after, min(max((at - first) / (last - first), 0.0), 1.0)
        return after, after, 0.0

    def spawned(self) -> list[int]:
        """Returns the predicted entities that the own one has spawned, in ascending order."""
        return [entity for entity in range(self.entity + 1, self.last_own + 1) if entity in self.predicted]

    def _placed(self, since: int, to: int) -> list[frozenset[int]]:
        """Returns the entities that the server's rules placed in the snapshots after the tick `since`, up to `to`."""
        placed = self.confirmed_copy.placed
        ticks = range(max(since, to - self.confirmed_copy.follow_max) + 1, to + 1)
        return [ids for tick in ticks if (ids := placed.get(tick))]

    def _state(self, entity: int, tick: int) -> State | None:
        """Returns the kept state of an entity at the end of a tick; None if none is kept."""
        states = self._states.get(tick)
        if states is None:
            return None
        row = row_in(states, entity, self._row)
        if row is None:
            return None
        self._row = row
        return tuple(states[row].tolist())

    def sync_test(self) -> tuple[int, Int64s, Int64s] | None:
        """Runs the sync test: replays everything since the confirmed world. Changes nothing unless state is hidden.

        Returns:
            The first tick whose states differ, with its states before and after; None: there is none.
        """
        ticks = range(self.confirmed.tick + 1, self.predicted.tick + 1)
        predicted_states = self._states.get(self.confirmed.tick)
        comparable = (
            predicted_states is not None  # and nothing is new, and nothing far away, that a replay would correct
            and not (self.confirmed_copy.terrain_changed or self._refused)
            and predicted_states.tobytes() == self._confirmed_states().tobytes()
        )
        before = [(tick, self._states.get(tick)) for tick in ticks] if comparable else []
        self.replay(self.predicted.tick)
        for tick, was in before:
            now = self._states.get(tick)
            if was is not None and now is not None and was.tobytes() != now.tobytes():
                return tick, was, now
        return None

    def _confirmed_states(self) -> Int64s:
        states = self.confirmed_copy.states
        return states if self.neighbours else self._comparison.own(states)

    def replay(self, to: int) -> None:
        """Predicts again from the confirmed world on, up to the tick `to`."""
        tick = self.confirmed.tick
        self.learn()
        self.announcements.begin(tick, final=not self._acts_differ)
        self._acts_differ = False
        if self._failed:
            self._failed = {failed for failed in self._failed if failed[0] > tick}
        self.predicted.restore(self.confirmed)
        self.confirmed_copy.terrain_changed = self.confirmed_copy.edited_near = self._refused = False
        if not self.neighbours:
            for entity in self.predicted.states()[:, ID].tolist():
                if not self.entity <= entity <= self.last_own:
                    self.predicted.forget(entity)
        self._states.put(self.confirmed.tick, self._confirmed_states())
        while self.predicted.tick < to:
            self.step()
        self.announcements.end()

    def learn(self) -> None:
        """Learns from a snapshot which announcements are final. Call it after each, also if more are about to come."""
        if not self.announcements.pending or self._acts_differ:
            return
        predicted_states = self._states.get(self.confirmed.tick)
        if predicted_states is not None and self._acts(predicted_states) != self._acts(self._confirmed_states()):
            self._acts_differ = True
        else:
            self.announcements.confirm(self.confirmed.tick)

    def _acts(self, states: Int64s) -> list[list[int]]:
        """Returns the counts of the acts of the own entity and of what it has spawned, with their numbers."""
        if not self.confirmed.scene.behaviours:
            return []
        own = self._comparison.own(states)
        acts: list[list[int]] = own[:, (ID, CELL + self.confirmed.extras.acts)].tolist()
        return acts
