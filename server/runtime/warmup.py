"""The warm-up: a short game before the real one, so that nothing is slow because it runs for the first time.

Python code is faster the second time, and a kernel that is not prebuilt is compiled here. Therefore scratch clients do
everything that a client can make a server do.
"""

from server.config.limits import Limits
from server.game import Game
from server.journal.recorded_world import RecordedWorld
from shared import edits, messages
from shared.aim import NO_AIM, make_aim
from shared.checks import SceneError
from shared.inputs import Input, row
from shared.messages import Bye, Command, Hello, Inputs, Message, Ping, Resync, encode
from shared.scene import Scene
from shared.units import SEGMENT

BUTTONS = 0xFF
"""All buttons of an input."""
TICKS = 40
"""Length of the warm-up in ticks: more than 32, so that a checksum of a segment is sent at least once."""


class _Void:
    """A link that discards everything."""

    def send(self, message: bytes) -> None: ...

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None: ...


def warm_up(scene: Scene, fresh: RecordedWorld | None = None) -> RecordedWorld:
    """Plays a short game in a scratch world: clients join, walk, jump, build, dig, fall out, shoot and leave.

    Args:
        scene: the scene.
        fresh: a new world of the scene with its terrain; None: it is made, which is half of the work.

    Returns:
        The new world, unused.

    Raises:
        SceneError: there is no room for a player at any spawn point, so no client could ever join.
    """
    scratch = RecordedWorld(scene)
    if fresh is None:
        fresh = RecordedWorld(scene)
        fresh.load_terrain()
    scratch.restore(fresh)
    game, now = Game(scene, limits=Limits(edits_per_s=10_000), world=scratch), 0.0

    def tick() -> None:
        nonlocal now
        now += 1 / scene.tick_rate
        game.tick(now, now)

    sessions = [game.open(_Void(), now) for _ in range(2)]

    def send(*sent: Message) -> None:
        for session in sessions:
            for message in sent:
                game.receive(session, encode(message), now)

    send(Ping(now), Hello(messages.VERSION, scene.digests, "warm-up"))
    tick()  # inputs count from here on
    joined = [session for session in sessions if session.entity]
    if not joined:
        raise SceneError(f"spawns = {scene.spawns}: no room for a {scene.player!r} at or near any of them")
    shooter, other = joined[0], joined[-1]
    x, y, z = (int(part // 1) for part in game.world.position(shooter.entity))
    aim = make_aim((1, 0, 0)) if scene.aim else NO_AIM
    for n in range(TICKS):
        at = game.world.tick
        send(Inputs(at + 1, at, row(Input(127, 0, n % 2 * BUTTONS, aim), aim=scene.aim)), Ping(now))
        # Edits of the block in which they stand (refused), on which they stand (dug), and above them (placed).
        cell = (x, y, z + (0, -1, 3)[n % 3])
        for kind in (1, 0):
            send(Command(2 * n + 1 - kind, at + 1, at - 1.5, edits.NAME, edits.pack(edits.Edit(*cell, kind))))
        tick()
        past = game.rewind.at(game.world.tick - 2.5, shooter.entity)
        past.ray((x, y, z + 1.0), (1.0, 0.25, -0.125), 32.0)
        past.box((x - 2.0, y - 2.0, z - 2.0), (x + 2.0, y + 2.0, z + 2.0))
    if other.entity in game.world:  # no behaviour has removed it
        game.world.place(other.entity, (x, y, scene.origin[2] * SEGMENT - 64.0))  # falls out, and is put at a spawn
    send(Resync())
    tick()
    tick()
    game.stats()
    send(Bye(messages.GOING_AWAY, "", -1.0))
    tick()
    return fresh
