"""The two worlds of a client, and how the one catches the other's mistakes.

Theory of operation. *Confirmed* is the server's world as of the newest snapshot, as far as this client sees it. It
is written, never stepped. *Predicted* is confirmed plus a replay: stepped by the same function with the own inputs,
while everybody else goes on with the latest input known of them. For every predicted tick the states are kept. When
the snapshot for tick T comes, it is compared with what was predicted for T, `==` on every bit of every entity:

    equal     the prediction stands; nothing is done
    not       predicted = confirmed, and the inputs for T+1 .. now are replayed

A difference in the own entity is a *correction* and is counted; one in others only is a *reprediction* (someone
pressed a key). No tolerance: the physics is exact, so a lone player is never corrected, whatever the network does.
"""

from dataclasses import dataclass

import numpy as np

from client_sdk.events import Corrected
from shared.checks import Cell
from shared.inputs import NEUTRAL, Input
from shared.layout import COLUMNS, ID, Int64s, X
from shared.messages import ProtocolError, Snapshot
from shared.ring import Ring
from shared.scene import Scene
from shared.snapshot import SegmentPart, decode_parts
from shared.units import BLOCK, BLOCK_SHIFT, SEGMENT_SHIFT
from shared.world import STATES, World

HISTORY = 256
"""Ticks for which predictions and inputs are kept."""
KEYFRAME = -1

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Reconciled:
    """What a snapshot did to the prediction."""

    correction: Corrected | None
    repredicted: bool
    replayed: int
    offset: Place
    """Where the own entity was shown, minus where it is now."""


class Prediction:
    """Confirmed and predicted world of one client, for its entity."""

    def __init__(self, scene: Scene, entity: int, *, compiled: bool | None = None) -> None:
        self.entity = entity
        self.confirmed = World(scene, compiled=compiled)
        self.predicted = World(scene, compiled=compiled)
        self.begun = False
        self._inputs: Ring[Input] = Ring(HISTORY)
        self._states: Ring[Int64s] = Ring(HISTORY)
        self._templates = len(scene.templates)
        self._terrain_changed = False

    # -- the server's word ---------------------------------------------------------------------------------

    def load_segment(self, segment: Cell, kinds: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> None:
        """The blocks of a segment have come."""
        self.confirmed.load_segment(segment, kinds)
        self._terrain_changed = True

    def apply(self, snapshot: Snapshot) -> None:
        """Writes a snapshot into the confirmed world.

        Raises:
            ProtocolError: a part of it is malformed.
        """
        world = self.confirmed
        parts, states = decode_parts(snapshot.segments, self._templates)
        here = set(states[:, ID].tolist())
        if snapshot.drops:
            self._drop(np.frombuffer(snapshot.drops, "<i4").reshape(-1, 3), here)
        homes = self._homes() if any(part.gone or part.since == KEYFRAME for part in parts) else {}
        for part in parts:
            for entity in self._gone(part, homes):
                if entity in world and entity not in here:
                    world.remove(entity)
            if len(part.edits) and part.segment in world.blocks:
                world.write_blocks(part.segment, part.edits["block"].tolist(), part.edits["kind"].tolist())
                self._terrain_changed = True
        if here:
            world.put(states)
        world.rebase(snapshot.tick)

    def _gone(self, part: SegmentPart, homes: dict[int, Cell]) -> list[int]:
        if part.since == KEYFRAME:
            return [entity for entity, home in homes.items() if home == part.segment]
        return [entity for entity in part.gone if homes.get(entity) == part.segment]

    def _homes(self) -> dict[int, Cell]:
        states = self.confirmed.states()
        segments = (states[:, X : X + 3] >> (BLOCK_SHIFT + SEGMENT_SHIFT)).tolist()
        return {entity: (x, y, z) for entity, (x, y, z) in zip(states[:, ID].tolist(), segments, strict=True)}

    def _drop(self, drops: np.ndarray[tuple[int, ...], np.dtype[np.int32]], here: set[int]) -> None:
        gone = {(x, y, z) for x, y, z in drops.tolist()}
        for entity, home in self._homes().items():
            if home in gone and entity not in here:
                self.confirmed.remove(entity)
        for segment in gone:
            if segment in self.confirmed.blocks and not len(self.confirmed.in_segment(segment)):
                self.confirmed.unload_segment(segment)
                self._terrain_changed = True

    # -- the guess -----------------------------------------------------------------------------------------

    def begin(self, tick: int) -> None:
        """(Re)starts the prediction at `tick` from the confirmed world, as if nothing had been pressed since."""
        self._inputs.clear()
        self._replay(tick)
        self.begun = True

    def step(self, wish: Input) -> None:
        """Predicts one tick with this input."""
        self._inputs.put(self.predicted.tick + 1, wish)
        self._step()

    def reconcile(self, cause: str) -> Reconciled:
        """Compares the newest confirmed tick with what was predicted for it, and replays if they differ.

        `cause` is the explanation of a correction in which no other entity differs.
        """
        tick = self.confirmed.tick
        if not self.begun or tick > self.predicted.tick:
            return Reconciled(None, False, 0, (0.0, 0.0, 0.0))
        guess, truth = self._states.get(tick), self.confirmed.states()
        if guess is not None and not self._terrain_changed and np.array_equal(guess, truth):
            return Reconciled(None, False, 0, (0.0, 0.0, 0.0))
        correction = self._correction(guess, truth, cause)
        shown, now = self._place(self.predicted), self.predicted.tick
        self._replay(now)
        place = self._place(self.predicted)
        offset = (shown[0] - place[0], shown[1] - place[1], shown[2] - place[2])
        return Reconciled(correction, correction is None, now - tick, offset)

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

    def _replay(self, to: int) -> None:
        self.predicted.restore(self.confirmed)
        self._terrain_changed = False
        while self.predicted.tick < to:
            self._step()

    def _step(self) -> None:
        wish = self._inputs.get(self.predicted.tick + 1)
        known = self.entity in self.predicted
        self.predicted.step({self.entity: wish or NEUTRAL} if known else None)
        self._states.put(self.predicted.tick, self.predicted.states())

    def _correction(self, guess: Int64s | None, truth: Int64s, cause: str) -> Corrected | None:
        mine = truth[truth[:, ID] == self.entity]
        if guess is None or not len(mine):
            return None
        was = guess[guess[:, ID] == self.entity]
        if np.array_equal(mine, was):
            return None
        if not len(was):
            was = np.zeros((1, STATES), np.int64)
        fields = tuple(COLUMNS[k] for k in np.flatnonzero(mine[0] != was[0]))
        way = (mine[0, X : X + 3] - was[0, X : X + 3]) / BLOCK
        ticks = self.predicted.tick - self.confirmed.tick
        return Corrected(self.confirmed.tick, fields, float(np.sqrt((way * way).sum())), ticks, cause)

    def _place(self, world: World) -> Place:
        return world.position(self.entity) if self.entity in world else (0.0, 0.0, 0.0)


def check_scene(table: object) -> Scene:
    """The scene in a welcome.

    Raises:
        ProtocolError: it is not a scene.
    """
    try:
        return Scene.from_table(table)  # type: ignore[arg-type]
    except (ValueError, TypeError) as error:
        raise ProtocolError(f"Welcome.scene: {error}") from error
