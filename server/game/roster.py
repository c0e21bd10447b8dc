"""Who plays: joins at a spawn, is kept for a while without a connection, comes back by a token, leaves.

A token is worth one return. Each welcome has a new one; the one before is good until the client has been heard from
over the new connection, for it may never have got the welcome. Only digests are kept.
"""

import hashlib
import math
import secrets

from server.config.limits import Limits
from server.game.session import Session
from server.game.spawning import Spawns
from server.game_api.api import Stage
from server.journal.recorded_world import RecordedWorld
from server.observability.counters import Counters
from server.players import persisted_state
from server.players.input_queue import InputQueue
from server.players.player import Player
from shared.bounds import bounds
from shared.messages import RESUME_BYTES

UNHEARD_S = 2.0
"""Who is cut off before it has acknowledged anything is kept for no longer than this."""


class Roster:
    """The players of one game, and where they stand when they come."""

    def __init__(self, world: RecordedWorld, stage: Stage, limits: Limits, counters: Counters) -> None:
        self.players: dict[int, Player] = stage.players
        """By entity, in the order in which they joined; also those whose connection is lost, for a while."""
        self._world, self._stage, self._limits, self._counters = world, stage, limits, counters
        self._bounds = bounds(world.scene.tick_rate)
        self._spawns = Spawns(world)
        self._fallen: list[int] = []
        for player in self.players.values():  # of a game that goes on
            player.inputs = InputQueue(self._bounds)

    @property
    def connected(self) -> int:
        """How many have a connection, if only one whose loss has not been noticed yet."""
        return sum(player.session is not None for player in self.players.values())

    def enter(self, session: Session, name: str) -> Player | None:
        """A new player at a spawn, with that connection; ask between two ticks. None: there is no room."""
        self._make_room()
        entity = self._spawns.spawn()
        if entity is None:
            return None
        player = self.players[entity] = Player(entity, name, session.subject, self._bounds)
        player.edits_left = 0.0  # else leaving and joining anew would give a burst each time
        player.announced = False
        self._counters.joined += 1
        try:
            session.seat(player)
            self._stage.joined(player)
        except Exception:
            self.expel(player)
            raise
        return player

    def issue(self, player: Player) -> bytes:
        """A token with which that player may come back."""
        token = secrets.token_bytes(RESUME_BYTES)
        player.tokens.append(_digest(token))
        self._world.note(persisted_state.note_of(player))
        return token

    def expel(self, player: Player) -> None:
        """Takes back a join that has failed: nothing of it stays."""
        if player.session is not None:
            player.session.vacate()
        self._let_go([player])

    def find(self, token: bytes, subject: str) -> Player | None:
        """The player who was given that token, which is used up with this; it may still have a connection."""
        wanted = _digest(token)
        for player in self.players.values() if token else ():
            if player.session is not None and player.session.stream.acked >= 0:
                player.heard()
            if wanted in player.tokens and player.subject == subject:
                player.tokens[:] = [wanted]  # the ones before it are used up, and one after it was never heard of
                return player
        return None

    def lost(self, session: Session, now: float) -> None:
        """The connection of a session is gone: its player has some time to come back."""
        player = session.player
        if player is None or player.session is not session:
            return
        known = session.stream.acked >= 0 or len(player.tokens) > 1
        if session.stream.acked >= 0:
            player.heard()
        player.session = None
        player.away_until = now + (self._limits.resume_s if known else min(UNHEARD_S, self._limits.resume_s))

    def dismiss(self, session: Session) -> None:
        """The player of this connection is not kept for a return."""
        if session.player is not None and session.player.session is session:
            session.player.session = None
            session.player.away_until = -math.inf

    def excuse(self, seconds: float, now: float) -> None:
        """In that time nobody could come back: it is added to what is left of theirs."""
        for player in self.players.values():
            if player.session is None:
                player.away_until = min(player.away_until + seconds, now + self._limits.resume_s)

    def leave(self, now: float) -> None:
        """Whose time to come back is over leaves."""
        away = [player for player in self.players.values() if player.session is None]
        for player in away:
            if player.away_until == math.inf:  # the server has been away
                player.away_until = now + self._limits.resume_s
        self._let_go([player for player in away if now >= player.away_until])

    def fell_out(self) -> None:
        """Who is below the floor comes back at a spawn, in the next tick, unless the rules have other plans."""
        self._fallen = self._world.fell
        self._counters.fell_out += len(self._fallen)

    def revive(self) -> None:
        """Those who fell out in the last tick come back."""
        for entity in self._fallen:
            if entity in self._world and not self._stage.fell_out(entity):
                self._spawns.put_back(entity)
        self._fallen.clear()

    def _make_room(self) -> None:
        """Lets go of those whose time to come back ends first, where there are as many players as there may be."""
        excess = len(self.players) + 1 - self._limits.clients_max
        if excess > 0:
            away = [player for player in self.players.values() if player.session is None]
            self._let_go(sorted(away, key=lambda player: player.away_until)[:excess])

    def _let_go(self, leaving: list[Player]) -> None:
        for player in leaving:
            del self.players[player.entity]
            self._counters.left += 1
            self._counters.add(player.inputs)
            self._stage.left(player)


def _digest(token: bytes) -> bytes:
    """What is kept of a token: enough to know it again, not enough to show it."""
    return hashlib.sha256(token).digest()
