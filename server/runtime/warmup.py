"""A game in miniature before the real one: what takes longer the first time has happened before anybody can see it.

Python itself is quicker the second time, and where no kernel is prebuilt, one is compiled here. So scratch clients do
everything that a client can make a server do.
"""

from server.config.limits import Limits
from server.game import Game
from server.journal.recorded_world import RecordedWorld
from shared import edits, messages
from shared.checks import SceneError
from shared.messages import Bye, Command, Hello, Inputs, Message, Ping, Resync, encode
from shared.scene import Scene
from shared.units import SEGMENT

TICKS = 40
"""Of a segment's checksum, which comes every 32 ticks, there is at least one."""


class _Void:
    """A link to nobody, that takes everything."""

    def send(self, message: bytes) -> None: ...

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None: ...


def warm_up(scene: Scene) -> RecordedWorld:
    """Joins, walks, jumps, builds, digs, falls out, shoots into the past and leaves, in a world of its own.

    Returns:
        A new world of the scene, untouched: generating its terrain is half of the work.

    Raises:
        SceneError: nobody could ever join.
    """
    fresh, scratch = RecordedWorld(scene), RecordedWorld(scene)
    fresh.load_terrain()
    scratch.restore(fresh)
    game, now = Game(scene, limits=Limits(edits_per_s=10_000), world=scratch), 0.0

    def tick() -> None:
        nonlocal now
        now += 1 / scene.tick_rate
        game.tick(now, now)

    sessions = [game.open(_Void(), now) for _ in range(2)]

    def say(*said: Message) -> None:
        for session in sessions:
            for message in said:
                game.receive(session, encode(message), now)

    say(Ping(now), Hello(messages.VERSION, scene.digests, "warm-up"))
    tick()  # inputs count from here on
    joined = [session for session in sessions if session.entity]
    if not joined:
        raise SceneError(f"spawns = {scene.spawns}: no room for a {scene.player!r} at any of them, or near")
    shooter, other = joined[0], joined[-1]
    x, y, z = (int(part // 1) for part in game.world.position(shooter.entity))
    for n in range(TICKS):
        at = game.world.tick
        say(Inputs(at + 1, at, bytes((127, 0, n % 2))), Ping(now))
        # Into the block in which they stand, on which they stand, and one above them: refused, dug, placed.
        cell = (x, y, z + (0, -1, 3)[n % 3])
        for kind in (1, 0):
            say(Command(2 * n + 1 - kind, at + 1, at - 1.5, edits.NAME, edits.pack(edits.Edit(*cell, kind))))
        tick()
        past = game.rewind.at(game.world.tick - 2.5, shooter.entity)
        past.ray((x, y, z + 1.0), (1.0, 0.25, -0.125), 32.0)
        past.box((x - 2.0, y - 2.0, z - 2.0), (x + 2.0, y + 2.0, z + 2.0))
    game.world.place(other.entity, (x, y, scene.origin[2] * SEGMENT - 64.0))  # comes back at a spawn
    say(Resync())
    tick()
    tick()
    game.stats()
    say(Bye(messages.GOING_AWAY, "", -1.0))
    tick()
    return fresh
