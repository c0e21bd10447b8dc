"""Connections: the sessions that are not on the fast path are known without a look at all others."""

from typing import cast

import pytest

from server.config.limits import Limits
from server.game import Game
from server.game.connections import Connections
from server.game.roster import Roster
from server.game.session import Session
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from shared import kernels, messages
from shared.messages import Hello, Inputs, encode
from shared.scene import load_scene


class Link:
    """A link over which everything arrives at once."""

    def send(self, message: bytes) -> None:
        pass

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        pass


class Silent:
    """A roster that does nothing for a lost connection."""

    def lost(self, session: Session, now: float) -> None:
        pass


def test_the_others_are_in_the_order_in_which_they_opened() -> None:
    connections = Connections(cast("Roster", Silent()), Counters(), FaultReporter())
    sessions = [connections.open(Link(), 0.0) for _ in range(9)]
    assert (connections.others, connections.mostly_fast) == (sessions, False)
    for session in sessions:
        connections.enrol(session)
    assert connections.others == []
    for session in (sessions[5], sessions[1], sessions[3]):
        connections.withdraw(session)
    assert (connections.others, connections.mostly_fast) == ([sessions[1], sessions[3], sessions[5]], True)
    connections.lost(sessions[3], 0.0)
    connections.lost(sessions[3], 0.0)
    assert connections.others == [sessions[1], sessions[5]]
    assert len(connections.sessions) == 8


@pytest.mark.skipif(not kernels.available(), reason="there is no compiled kernel")
def test_one_who_loses_the_connection_leaves_in_time_while_the_others_are_on_the_fast_path() -> None:
    game, now = Game(load_scene("flat"), limits=Limits(resume_s=1.0), compiled=True), 0.0
    sessions = [game.open(Link(), now) for _ in range(8)]
    for number, session in enumerate(sessions):
        game.receive(session, encode(Hello(messages.VERSION, {}, f"player {number}")), now)
    left, lost_at = [], 0
    for _ in range(3 * game.scene.tick_rate):
        tick = game.world.tick
        for session in sessions:
            if session.entity and not session.closed:
                game.receive(session, encode(Inputs(tick + 2, tick, bytes(3))), now)
        now += 1 / game.scene.tick_rate
        game.tick(now, now)
        left.append(len(game.players))
        if game.connections.fast == len(sessions):
            game.lost(sessions[2], now)
            lost_at = game.world.tick
    assert left[lost_at + game.scene.tick_rate // 2] == 8, "the player may reconnect"
    assert left[lost_at + game.scene.tick_rate + 1] == 7
    assert game.connections.fast == 7
