"""The replica: everything that a client knows of one server since the welcome.

Theory of operation. A replica joins the confirmed world, which snapshots and terrain write; the prediction on top of
it; the view builder, which makes views of both; and the clock, which estimates the server's time. After a lost
connection, the client keeps playing in the old replica while the messages of the new connection fill a second one. Once
the second is complete (`complete`), it takes over the inputs and edits of the first (`take_over`). Both share one clock
if the new welcome agrees with it within `CLOCK_S` seconds: then the client's timeline goes on.
"""

from collections.abc import Sequence

from client_sdk.controls import Controls
from client_sdk.prediction.confirmed import Confirmed
from client_sdk.prediction.prediction import Prediction
from client_sdk.timing.server_clock import ServerClock
from client_sdk.view_builder import ViewBuilder
from shared.behaviours import Behaviour
from shared.blocks import unpack
from shared.checks import Cell
from shared.kernels import Kernel
from shared.messages import ProtocolError, Snapshot, Terrain, Welcome
from shared.scene import Scene

CLOCK_S = 1.0
"""Largest difference in seconds between the known server time and the one in a welcome. Beyond it, the server was
restarted or stood still, and the client starts a new clock."""


class Replica:
    """A copy of the server's world, which messages fill, with its prediction, its view builder and its clock.

    Args:
        welcome: the message that the connection began with.
        clock: the clock of the connection before; it stays in use if the welcome agrees with it.
        now: local time in seconds.
        controls: where the input delay is set.
        behaviours: this program's classes of the game's behaviours.
        neighbours: whether the predicted world has other entities, so that blocking each other is predicted.
        compiled: True for a compiled kernel, False for the plain one, None for the chosen one.

    Raises:
        ProtocolError: the welcome is malformed.
        BehaviourError: the scene needs behaviours that this program does not have.
    """

    def __init__(
        self,
        welcome: Welcome,
        clock: ServerClock,
        now: float,
        *,
        controls: Controls,
        behaviours: Sequence[type[Behaviour]] = (),
        neighbours: bool,
        compiled: bool | None,
    ) -> None:
        self.scene = check_scene(welcome.scene).bound(behaviours)
        self.confirmed = Confirmed(self.scene, welcome.entity, compiled=compiled)
        self.prediction = Prediction(self.confirmed, controls, neighbours=neighbours)
        self.view_builder = ViewBuilder(self.scene, self.prediction)
        self.clock = clock
        if clock.rate == 0 or abs(clock.tick(now) - welcome.tick) > CLOCK_S * self.scene.tick_rate:
            self.clock = ServerClock()
            self.clock.rate = float(self.scene.tick_rate)
        self.newest_received = -1
        """Newest tick for which the server has received an input; -1 before the first snapshot."""
        self.wrong = ""
        """Text that names a difference from the server's world, for `Diverged`; empty if there is none."""
        self._pieces: tuple[Cell, bytearray] = ((0, 0, 0), bytearray())

    def use(self, kernel: Kernel) -> None:
        """Replaces the kernel of both worlds."""
        self.prediction.confirmed.use(kernel)
        self.prediction.predicted.use(kernel)

    @property
    def complete(self) -> bool:
        """Whether enough is known to play: the server's time, the own entity and the terrain around it."""
        confirmed = self.confirmed
        return self.clock.ready and confirmed.entity in confirmed.world and confirmed.grounded()

    def terrain(self, terrain: Terrain) -> Cell | None:
        """Takes a piece of a segment's terrain. Edits that arrived between the pieces are applied to it.

        Returns:
            The segment if it is complete now, otherwise None.

        Raises:
            ProtocolError: a piece is missing, or the pieces do not contain valid blocks.
        """
        segment = (terrain.x, terrain.y, terrain.z)
        if terrain.offset == 0:
            self._pieces = (segment, bytearray())
            self.confirmed.expect_segment(segment)
        if self._pieces[0] != segment or len(self._pieces[1]) != terrain.offset:
            raise ProtocolError("Terrain: a piece is missing")
        self._pieces[1].extend(terrain.chunk)
        if len(self._pieces[1]) < terrain.total:
            return None
        try:
            kinds = unpack(bytes(self._pieces[1]))
        except ValueError as error:
            raise ProtocolError(f"Terrain.chunk: {error}") from error
        self.confirmed.load_segment(segment, kinds)
        return segment

    def skipped(self, snapshot: Snapshot) -> int:
        """Returns the number of ticks between the snapshot before and this one.

        Raises:
            ProtocolError: this one is not newer.
        """
        world = self.confirmed.world
        if snapshot.tick <= world.tick:
            raise ProtocolError(f"Snapshot.tick = {snapshot.tick}: not newer than the one before")
        return snapshot.tick - world.tick - 1 if len(world) else 0

    def apply(self, snapshot: Snapshot) -> None:
        """Writes a snapshot into the confirmed world, and adds the states to the interpolation history.

        Raises:
            ProtocolError: a part of the snapshot is malformed.
        """
        self.newest_received = max(self.newest_received, snapshot.newest)
        self.wrong = self.confirmed.apply(snapshot) or self.wrong
        self.prediction.learn()
        placed = self.confirmed.placed.get(snapshot.tick)
        self.view_builder.interpolation.push(snapshot.tick, self.confirmed.states, placed or frozenset())

    def take_over(self, old: "Replica") -> bool:
        """Takes the place of an earlier replica, and its inputs and edits if the own entity is the same.

        Returns:
            Whether the own entity is the same.
        """
        self.wrong = self.wrong or old.wrong  # an alarm must survive the reconnect
        same = self.prediction.entity == old.prediction.entity
        if same:
            self.prediction.adopt(old.prediction)
        return same


def check_scene(table: object) -> Scene:
    """Returns the scene of a welcome.

    Raises:
        ProtocolError: `table` is not a valid scene.
    """
    try:
        scene = Scene.from_table(table)  # type: ignore[arg-type]
        assert scene.digests  # computes the digests now, so that an impossible table is refused here
        return scene
    except (ValueError, TypeError, RecursionError) as error:
        raise ProtocolError(f"Welcome.scene: {error}") from error
