"""The fast path of an edge against its specification, in a world on many processes: every byte that clients get is the
same, whatever happens to the parts and on the bus.
"""

import random
import secrets
from typing import Any

import pytest

from client_sdk.netsim.links import PRESETS
from server.scale.edge import EdgeServer
from shared import kernels
from shared.scene import load_scene
from sovereign_netcode.playtest.match import wander
from sovereign_netcode.playtest.scaled import ScaledMatch, Seat
from tests.lengths import contained, long
from tests.scaling import edits

pytestmark = pytest.mark.skipif(not kernels.available(), reason="there is no compiled kernel")

LATE = {"jitter_s": 0.03, "stop": (1.0, 0.3), "twice": 0.05, "lost": 0.01}
"""A bus that is often late, stops, sends twice, and loses messages."""


def played(seed: int, *, fast: bool, seconds: float, bus: dict[str, Any], kills: bool) -> tuple[list[Any], int]:
    """Plays a seeded match. Returns all that its clients were sent, and how often a session was on the fast path."""
    sent: list[list[bytes]] = []
    on = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(secrets, "token_bytes", random.Random(seed).randbytes)
        plain_init, plain_send = EdgeServer.__init__, Seat.send

        def made(self: EdgeServer, *arguments: Any, **named: Any) -> None:
            plain_init(self, *arguments, **named)
            if not fast:
                self.fast_path = None

        def send(self: Seat, message: bytes) -> None:
            sent[match.players.index(self)].append(bytes(message))
            plain_send(self, message)

        patch.setattr(EdgeServer, "__init__", made)
        patch.setattr(Seat, "send", send)
        match = ScaledMatch(load_scene("arena"), seed, edges=3, standbys=1, bus=bus)
        links = list(PRESETS.values())
        for number in range(8):
            sent.append([])
            match.join((wander, edits)[number % 2], links[(seed + number) % len(links)])
        rng = random.Random(seed)
        for step in range(int(2 * seconds)):
            match.run(0.5)
            on += sum(session.row >= 0 for edge in match.edges for session in edge.core.sessions)
            if kills and step % 8 == 5:
                match.kill(rng.choice([edge for edge in match.edges if edge.alive]), lossy=True)
                match.add_edge()
            if step % 5 == 3:
                living = [edge for edge in match.edges if edge.alive]
                player = match.players[rng.randrange(8)]
                assert isinstance(player, Seat)
                player.move(rng.choice(living))
    assert match.differ == []
    counts = [(player.core.stats.corrections, player.core.stats.divergences) for player in match.players]
    assert all(divergences == 0 for _, divergences in counts)
    stats = [edge.core.stats() for edge in match.edges]
    return [sent, counts, stats, match.sequencer.core.world.state_hash()], on


@pytest.mark.parametrize("kills", [False, True])
@pytest.mark.parametrize("bus", [{}, LATE], ids=["quiet", "late"])
@pytest.mark.parametrize(("seed", "seconds"), [*contained((1, 6.0)), *long((1, 9.0), (2, 9.0))])
def test_every_byte_is_the_same(seed: int, seconds: float, bus: dict[str, Any], kills: bool) -> None:
    fast, on = played(seed, fast=True, seconds=seconds, bus=bus, kills=kills)
    slow, never = played(seed, fast=False, seconds=seconds, bus=bus, kills=kills)
    for one, other in zip(fast, slow, strict=True):
        assert one == other
    assert on > (0 if bus else 8 * seconds // 2), "the fast path was used"
    assert never == 0
