"""The store of a new world among many, whose thread makes the files, so that no tick waits for the disk."""

from collections.abc import Callable
from pathlib import Path

from server.persistence import checkpoint
from server.persistence.checkpoint import Checkpoint
from server.persistence.database import Database, StoreError
from server.persistence.restore import Loaded
from server.persistence.store import Store
from shared.scene import Scene
from shared.world import World


class NewStore(Store):
    """A store in a directory without a world. Until its files are there, nothing is durable.

    Args:
        directory, scene, game, power, checkpoint_s, terrain: as for `Store`.
        created: called in the store's thread before the database is made. It may raise an `OSError`; then it is called
            again later.

    Raises:
        StoreError: the directory cannot be used, or has a world.
    """

    def __init__(
        self,
        directory: Path,
        scene: Scene,
        created: Callable[[], None],
        *,
        game: str,
        power: bool,
        checkpoint_s: float,
        terrain: World,
    ) -> None:
        self._created: Callable[[], None] | None = created
        self._initial: Checkpoint | None = None
        super().__init__(directory, scene, game=game, power=power, checkpoint_s=checkpoint_s, terrain=terrain)

    def _load(self, scene: Scene, compiled: bool | None, terrain: World | None) -> Loaded:
        if self._path.exists():
            raise StoreError(f"{self._path}: exists already")
        world, self._initial = checkpoint.generated(scene, compiled=compiled, terrain=terrain)
        return Loaded(world, None, [], world.tick, 0, 0, checkpoint.saved_of(world))

    def _reopen(self) -> None:
        """Makes the file with the first checkpoint. If that has failed, saves a new one as after any gap."""
        if self._created is not None:
            with self._wake:
                if self.trouble:
                    self._wake.wait_for(lambda: self._closing, self._retry_s)
                self._copying = self._copy  # if this fails while the store is being closed, it is given up
            self._created()
            self._created = None
        first, self._initial = self._initial, None
        if first is None or self.trouble:
            super()._reopen()
            return
        file = Database(self._path, power=self._power)
        try:
            file.save(first, self._rules, 0, self._game)
            self._seals = {file.seal(): self._saved}
            self._file = file
        finally:
            if self._file is not file:
                file.close()
