"""A world and a second one that gets only what is sent of the first: the two must be equal at every tick."""

import msgpack

from shared.snapshot import TickEncoder, decode_parts, join_part
from shared.world import World


class Mirrored:
    """A stepped world, and a second world that knows only what was sent of the first."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.packs = TickEncoder(world, 1)
        self.other = World(world.scene, compiled=world.compiled)
        self.other.put(world.states())
        self.other.rebase(world.tick)
        self.turns = self.sent_turns = self.bytes = 0

    def send(self) -> None:
        """Sends the changes of the latest step to the other world, segment by segment, over the wire format."""
        self.turns += len(self.world.changed)
        shares, _ = self.packs.pack(())
        self.sent_turns += sum(len(share.ids) for share in shares)
        parts = [join_part(share.segment, 1, share.packed) for share in shares]
        self.bytes += sum(map(len, parts))
        templates = len(self.world.scene.templates)
        _, states, turns = decode_parts(list(map(msgpack.unpackb, parts)), templates, self.world.kernel)
        self.other.put(states)
        for entity in set(self.other.states()[:, 0].tolist()) - set(self.world.states()[:, 0].tolist()):
            self.other.remove(entity)
        assert self.other.follow(turns, self.world.tick - self.other.tick, self.world.tick)

    def check(self) -> None:
        assert self.other.states().tolist() == self.world.states().tolist()
