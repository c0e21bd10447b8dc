"""What a client knows of a server: the world around the player, from the welcome on, and the server's time."""

from client_sdk.clock import ServerClock
from client_sdk.confirmed import Confirmed
from client_sdk.picture import Picture
from client_sdk.prediction import Prediction
from shared.blocks import unpack
from shared.checks import Cell
from shared.kernels import Kernel
from shared.messages import ProtocolError, Snapshot, Terrain, Welcome
from shared.scene import Scene

CLOCK_S = 1.0
"""A server whose time is this far from what it was believed to be is not the same one any more, or was away."""


class Replica:
    """Is filled by messages; after a return beside the one that is still played in.

    Args:
        clock: that of the server known before, which may be the same one.
        neighbours: see `Prediction`.
        compiled: see `World`.

    Raises:
        ProtocolError: the welcome is malformed.
    """

    def __init__(
        self, welcome: Welcome, clock: ServerClock, now: float, *, neighbours: bool, compiled: bool | None
    ) -> None:
        self.scene = check_scene(welcome.scene)
        self.known = Confirmed(self.scene, welcome.entity, compiled=compiled)
        self.prediction = Prediction(self.known, neighbours=neighbours)
        self.picture = Picture(self.scene, self.prediction)
        self.clock = clock
        if clock.rate == 0 or abs(clock.tick(now) - welcome.tick) > CLOCK_S * self.scene.tick_rate:
            self.clock = ServerClock()
            self.clock.rate = float(self.scene.tick_rate)
        self.heard = -1
        """The newest tick that the server has an input for."""
        self.wrong = ""
        """What is not as the server has it, if anything."""
        self._pieces: tuple[Cell, bytearray] = ((0, 0, 0), bytearray())

    def use(self, kernel: Kernel) -> None:
        """Goes on with another kernel."""
        self.prediction.confirmed.use(kernel)
        self.prediction.predicted.use(kernel)

    @property
    def complete(self) -> bool:
        """Whether enough is known to play: the time, the own entity and the ground around it."""
        known = self.known
        return self.clock.ready and known.entity in known.world and known.grounded()

    def terrain(self, terrain: Terrain) -> Cell | None:
        """A piece of a segment; the segment, if it was the last. Edits that came in between are made up for.

        Raises:
            ProtocolError: a piece is missing, or these are no blocks.
        """
        segment = (terrain.x, terrain.y, terrain.z)
        if terrain.offset == 0:
            self._pieces = (segment, bytearray())
            self.known.expect_segment(segment)
        if self._pieces[0] != segment or len(self._pieces[1]) != terrain.offset:
            raise ProtocolError("Terrain: a piece is missing")
        self._pieces[1].extend(terrain.chunk)
        if len(self._pieces[1]) < terrain.total:
            return None
        try:
            kinds = unpack(bytes(self._pieces[1]))
        except ValueError as error:
            raise ProtocolError(f"Terrain.chunk: {error}") from error
        self.known.load_segment(segment, kinds)
        return segment

    def skipped(self, snapshot: Snapshot) -> int:
        """The ticks between the snapshot before and this one.

        Raises:
            ProtocolError: it is not newer.
        """
        world = self.known.world
        if snapshot.tick <= world.tick:
            raise ProtocolError(f"Snapshot.tick = {snapshot.tick}: not newer than the one before")
        return snapshot.tick - world.tick - 1 if len(world) else 0

    def apply(self, snapshot: Snapshot) -> None:
        """The confirmed world becomes that of the snapshot.

        Raises:
            ProtocolError: a part of it is malformed.
        """
        self.heard = max(self.heard, snapshot.newest)
        self.wrong = self.known.apply(snapshot) or self.wrong
        placed = self.known.placed.get(snapshot.tick)
        self.picture.interpolation.push(snapshot.tick, self.known.states, placed or frozenset())

    def take_over(self, old: "Replica") -> bool:
        """Takes the place of an earlier copy; whether the own entity is the same, so that what it does goes on."""
        self.wrong = self.wrong or old.wrong  # an alarm is not lost with the connection
        same = self.prediction.entity == old.prediction.entity
        if same:
            self.prediction.adopt(old.prediction)
        return same


def check_scene(table: object) -> Scene:
    """The scene in a welcome.

    Raises:
        ProtocolError: it is not a scene.
    """
    try:
        scene = Scene.from_table(table)  # type: ignore[arg-type]
        assert scene.digests  # computed here, where a table that cannot be is refused
        return scene
    except (ValueError, TypeError, RecursionError) as error:
        raise ProtocolError(f"Welcome.scene: {error}") from error
