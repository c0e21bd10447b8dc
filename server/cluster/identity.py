"""The identity of a world on a bus: all its parts must compute the same world."""

import json
from collections.abc import Mapping

from server.cluster.bus import Bus, ConflictError
from shared import kernels
from shared.scene import Scene


class IdentityError(Exception):
    """A part that belongs to another world than the one with this name on the bus."""


def identity_of(scene: Scene, *, seed: int, game: str, options: Mapping[str, object]) -> dict[str, str]:
    """Returns the identity of a world by fields.

    Args:
        scene: the scene.
        seed: seed of the rules' random numbers.
        game: the class of the rules, MODULE:CLASS; empty: none.
        options: options of the game.
    """
    digests = {f"scene.{name}": digest.hex() for name, digest in scene.digests.items()}
    given = ", ".join(f"{name}={value}" for name, value in sorted(options.items()))
    return {"game": game, "options": given, "seed": str(seed), "kernel": kernels.source_hash(), **digests}


async def join_world(bus: Bus, world: str, mine: Mapping[str, str]) -> None:
    """Checks that a part belongs to a world, or gives the world its identity if it has none yet.

    Args:
        bus: the bus.
        world: name of the world.
        mine: identity of the part (`identity_of`).

    Raises:
        IdentityError: the part belongs to another world. The text names the fields.
    """
    key = f"{world}.identity"
    known = await bus.get(key)
    if known is None:
        try:
            await bus.put(key, json.dumps(dict(mine)).encode(), 0)
            return
        except ConflictError:
            known = await bus.get(key)
    theirs = {} if known is None else json.loads(known.value)
    differ = sorted(name for name in mine.keys() | theirs.keys() if mine.get(name) != theirs.get(name))
    if differ:
        shown = ", ".join(f"{name}: {_short(mine, name)} here, {_short(theirs, name)} there" for name in differ[:4])
        raise IdentityError(f"the world {world!r} on the bus is another one ({shown})")


def _short(identity: Mapping[str, str], name: str) -> str:
    return (identity.get(name) or "none")[:40]
