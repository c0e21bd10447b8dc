"""What a client knows of a server: the world around the player, from the welcome on, and the server's time."""

from client_sdk.clock import ServerClock
from client_sdk.picture import Picture
from client_sdk.prediction import Prediction
from shared.blocks import unpack
from shared.checks import Cell
from shared.messages import ProtocolError, Snapshot, Terrain
from shared.scene import Scene


class Replica:
    """Is filled by messages; after a return beside the one that is still played in."""

    def __init__(self, scene: Scene, prediction: Prediction, clock: ServerClock) -> None:
        self.prediction = prediction
        self.picture = Picture(scene, prediction)
        self.clock = clock
        self._pieces: tuple[Cell, bytearray] = ((0, 0, 0), bytearray())

    @property
    def complete(self) -> bool:
        """Whether enough is known to play: the time, the own entity and the ground around it."""
        prediction = self.prediction
        return self.clock.ready and prediction.entity in prediction.confirmed and prediction.grounded()

    def terrain(self, terrain: Terrain) -> Cell | None:
        """A piece of a segment; the segment, if it was the last. Edits that came in between are made up for.

        Raises:
            ProtocolError: a piece is missing, or these are no blocks.
        """
        segment = (terrain.x, terrain.y, terrain.z)
        if terrain.offset == 0:
            self._pieces = (segment, bytearray())
            self.prediction.expect_segment(segment)
        if self._pieces[0] != segment or len(self._pieces[1]) != terrain.offset:
            raise ProtocolError("Terrain: a piece is missing")
        self._pieces[1].extend(terrain.chunk)
        if len(self._pieces[1]) < terrain.total:
            return None
        try:
            kinds = unpack(bytes(self._pieces[1]))
        except ValueError as error:
            raise ProtocolError(f"Terrain.chunk: {error}") from error
        self.prediction.load_segment(segment, kinds)
        return segment

    def skipped(self, snapshot: Snapshot) -> int:
        """The ticks between the snapshot before and this one.

        Raises:
            ProtocolError: it is not newer.
        """
        confirmed = self.prediction.confirmed
        if snapshot.tick <= confirmed.tick:
            raise ProtocolError(f"Snapshot.tick = {snapshot.tick}: not newer than the one before")
        return snapshot.tick - confirmed.tick - 1 if len(confirmed) else 0

    def apply(self, snapshot: Snapshot) -> str:
        """The confirmed world becomes that of the snapshot; what is wrong with it, or nothing."""
        wrong = self.prediction.apply(snapshot)
        self.picture.interpolation.push(snapshot.tick, self.prediction.truth)
        return wrong
