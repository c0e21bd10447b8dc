"""The roster: the list of players, from their join at a spawn point to their end, with reconnects between.

A resume token allows one reconnect. Each welcome has a new token. The former token stays valid until the client has
acknowledged a snapshot over the new connection, because the welcome may have been lost. Only digests of tokens are
kept.
"""

import hashlib
import math
import secrets
from typing import Any

from server.config.limits import Limits
from server.game.names import named
from server.game.session import Session
from server.game.spawning import Spawns
from server.game_api.api import GameApi
from server.journal.recorded_world import RecordedWorld
from server.observability.counters import Counters
from server.players import persisted_state
from server.players.input_queue import InputQueue
from server.players.player import Player
from shared.bounds import bounds
from shared.fields import NAME_MAX, RESUME_BYTES

UNACKNOWLEDGED_S = 2.0
"""Seconds that a new player may take to reconnect if its client has not acknowledged anything yet."""


class Roster:
    """The players of one game.

    Args:
        world: the world.
        api: the game API, which is notified of joins and leaves.
        limits: the limits.
        counters: where joins and leaves are counted.
    """

    def __init__(self, world: RecordedWorld, api: GameApi, limits: Limits, counters: Counters) -> None:
        self._world, self._api, self._limits, self._counters = world, api, limits, counters
        self._bounds = bounds(world.scene.tick_rate)
        self._spawns = Spawns(world)
        self._fallen: list[int] = []
        for player in self._api.players.values():  # players of a restored game
            player.inputs = self._queue()

    def _queue(self) -> InputQueue:
        """Returns a new input queue for the scene."""
        return InputQueue(self._bounds, self._world.scene.input_row_bytes)

    @property
    def players(self) -> dict[int, Player]:
        """Players by entity."""
        return self._api.players

    @property
    def full(self) -> bool:
        """Whether as many players as may play have a connection, or one whose loss has not been noticed yet."""
        players, most = self._api.players, self._limits.clients_max
        return len(players) >= most and sum(player.session is not None for player in players.values()) >= most

    def enter(self, session: Session, name: str, loaded: Any = None) -> Player | None:
        """Adds a new player at a spawn point. Call it before the step of a tick.

        Args:
            session: the connection of the player.
            name: the name of the player.
            loaded: the result of `Rules.load_player`.

        Returns:
            The player, or None if there is no room.
        """
        self._make_room()
        entity = self._spawns.spawn()
        if entity is None:
            return None
        player = self._api.players[entity] = Player(entity, name, session.subject, self._queue())
        player.edits_left, player.edits_tick = 0.0, self._world.tick  # a leave and a new join give no other burst
        player.announced, player.loaded = False, loaded
        if session.reserved is not None:
            player.handed, session.reserved.player = session.reserved.data, player
        self._counters.joined += 1
        try:
            session.seat(player)
            self._api.hooks.joined(player)
        except Exception:
            self.expel(player)
            raise
        return player

    def admit(self, wanted: str, subject: str) -> tuple[str, str]:
        """Returns the name of a new player, and the reason why it may not join; empty if it may.

        Args:
            wanted: the name that the client gave.
            subject: the subject of the client.
        """
        rule = self._api.hooks.names
        taken = () if rule == "any" else [player.name for player in self._api.players.values()]
        name = named(wanted, rule, taken, min(NAME_MAX, self._limits.name_max))
        return name, self._api.hooks.not_admitted(name, subject)

    def issue(self, player: Player) -> bytes:
        """Makes a new resume token for a player and returns it."""
        token = secrets.token_bytes(RESUME_BYTES)
        self.grant(player, digest_of(token))
        return token

    def grant(self, player: Player, digest: bytes) -> None:
        """Adds a resume token, given by its digest, to those of a player."""
        player.tokens.append(digest)
        self._world.note(persisted_state.note_of(player))

    def private_of(self, player: Player) -> bytes:
        """Returns the message with the values that only this player gets; empty if there have never been any."""
        return self._api.kept.private_of(player.entity)

    def expel(self, player: Player) -> None:
        """Undoes a join that has failed."""
        if player.session is not None:
            player.session.vacate()
        self._let_go([player])

    def knows(self, token: bytes, subject: str) -> bool:
        """Returns whether a player has a resume token and a subject; unlike `find`, this changes nothing."""
        if not token:
            return False
        wanted = self._digest(token)
        return any(wanted in player.tokens and player.subject == subject for player in self._api.players.values())

    def find(self, token: bytes, subject: str) -> Player | None:
        """Returns the player with a resume token and a subject, or None. The token is used up by this.

        The player may still have a connection.

        Args:
            token: the token from the client's hello; empty if it has none.
            subject: the subject of the client.
        """
        if not token:
            return None
        wanted = self._digest(token)
        for player in self._api.players.values():
            if player.session is not None and player.session.acknowledged:
                player.drop_older_tokens()
            if wanted in player.tokens and player.subject == subject:
                player.tokens[:] = [wanted]  # an older token is used up, and the client never got a newer one
                return player
        return None

    def seated(self, session: Session) -> Player | None:
        """Returns the player who has joined on a session's seat over a connection that was lost at once; None: none."""
        player = session.reserved.player if session.reserved is not None else None
        here = player is not None and self._api.players.get(player.entity) is player
        return player if here and player is not None and player.subject == session.subject else None

    def lost(self, session: Session, now: float) -> None:
        """Handles a lost connection: starts the time in which its player can reconnect."""
        player = session.player
        if player is None or player.session is not session:
            return
        known = session.acknowledged or len(player.tokens) > 1
        if session.acknowledged:
            player.drop_older_tokens()
            if session.reserved is not None:
                session.reserved.settled = True
        player.session = None
        player.reconnect_until = now + (
            self._limits.resume_s if known else min(UNACKNOWLEDGED_S, self._limits.resume_s)
        )

    def dismiss(self, session: Session) -> None:
        """Makes the player of a session leave in the next tick, without a chance to reconnect."""
        if session.player is not None and session.player.session is session:
            session.player.session = None
            session.player.reconnect_until = -math.inf

    def excuse(self, seconds: float, now: float) -> None:
        """Extends the time to reconnect of all players by a pause of the server, in which nobody could reconnect."""
        for player in self._api.players.values():
            if player.session is None:
                player.reconnect_until = min(player.reconnect_until + seconds, now + self._limits.resume_s)

    def leave(self, now: float) -> None:
        """Removes the players whose time to reconnect is over."""
        away = [player for player in self._api.players.values() if player.session is None]
        for player in away:
            if player.reconnect_until == math.inf:  # the player of a restored game
                player.reconnect_until = now + self._limits.resume_s
        self._let_go([player for player in away if now >= player.reconnect_until])

    def fell_out(self) -> None:
        """Takes note of the entities that fell out of the world in this step, for `revive` in the next tick."""
        self._fallen = self._world.fell
        self._counters.fell_out += len(self._fallen)

    def revive(self) -> None:
        """Puts the entities that fell out in the last tick at spawn points, unless the rules deal with them.

        An entity that a behaviour has spawned is removed instead.
        """
        for entity in self._fallen:
            if entity in self._world and not self._api.hooks.fell_out(entity):
                if self._world.owner(entity) is None:
                    self._spawns.put_back(entity)
                else:
                    self._api.discard(entity)
        self._fallen.clear()

    def _digest(self, token: bytes) -> bytes:
        """Returns the digest that a player has of a token."""
        return digest_of(token)

    def _make_room(self) -> None:
        """Removes players without a connection if the game is full; first the one with the least time left."""
        excess = len(self._api.players) + 1 - self._limits.clients_max
        if excess > 0:
            away = [player for player in self._api.players.values() if player.session is None]
            self._let_go(sorted(away, key=lambda player: player.reconnect_until)[:excess])

    def _let_go(self, leaving: list[Player]) -> None:
        for player in leaving:
            del self._api.players[player.entity]
            self._counters.left += 1
            self._counters.add(player.inputs)
            self._api.hooks.left(player)


def digest_of(token: bytes) -> bytes:
    """Returns the digest of a token: it recognises the token, but cannot be used in its place."""
    return hashlib.sha256(token).digest()
