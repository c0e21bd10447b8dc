"""The sequencer half of a game: the only place where the world changes.

Theory of operation. A tick of a game has two halves. The sequencer half lets players leave and join, carries out their
commands, runs the rules and steps the world. It needs no connections: requests wait with the sessions and players, and
its results are the world, the persisted state and the `Outcome` of the tick. The edge half (`server.game.edge`) makes
of these what each client gets.
"""

from typing import Protocol

from server.game.commands import Commands
from server.game.connections import Connections
from server.game.fast_path import FastPath
from server.game.roster import Roster
from server.game_api.api import GameApi
from server.journal.recorded_world import RecordedWorld
from server.players.player import Player
from server.replication.outcome import Outcome
from server.rewind import Rewind
from shared import messages
from shared.inputs import Input


class Joins(Protocol):
    """The clients that wait to join (`server.game.joining`)."""

    def join(self, now: float) -> None:
        """Lets clients that wait join."""


class Sequencer:
    """The sequencer half of one game.

    Args:
        world: the world.
        api: the game API, which calls the rules.
        rewind: the recent past of the world.
        roster: the players.
        joining: the clients that wait to join.
        commands: the commands of the players.
        connections: ends the connections of players that are removed.
    """

    def __init__(
        self,
        world: RecordedWorld,
        api: GameApi,
        rewind: Rewind,
        roster: Roster,
        joining: Joins,
        commands: Commands,
        connections: Connections,
    ) -> None:
        self._world, self._api, self._rewind, self._roster = world, api, rewind, roster
        self._joining, self._commands, self._connections = joining, commands, connections
        self.fast_path: FastPath | None = None
        """Takes the inputs of sessions on the fast path; None: there is none."""

    def advance(self, now: float) -> Outcome:
        """Computes the next tick. Returns its outcome, which is valid until the next call."""
        api, world = self._api, self._world
        with api.turn:
            api.hooks.start()
            if len(api.players) > self._connections.fast and self._some_are_away():
                self._roster.leave(now)
            self._joining.join(now)
            self._roster.revive()
            self._commands.carry_out()
            api.hooks.act()
        world.step(self.take_inputs())
        for entity in api.turn_results.take():
            if entity in api.players:
                reason = "the game has removed this player's entity"
                self._connections.remove(api.players[entity], messages.GOING_AWAY, reason)
        api.hooks.stepped()
        self._rewind.record()
        self._roster.fell_out()
        return api.outcome

    def _some_are_away(self) -> bool:
        """Returns whether there may be players without a connection."""
        return len(self._api.players) > self._connections.fast + len(self._connected())

    def _connected(self) -> list[Player]:
        """Returns the players who have a connection that is not on the fast path, if they are a few; otherwise none."""
        connections, players = self._connections, self._api.players
        found = []
        for session in connections.others if connections.mostly_fast else ():
            player = session.player
            if player is not None and player.session is session and players.get(player.entity) is player:
                found.append(player)
        return found

    def finish(self) -> None:
        """Ends the tick once its outcome was used: removes players whom the rules have kicked or sent away."""
        api = self._api
        api.outcome.clear()
        for player, go in api.sent_away:
            self._connections.send_away(player, go)
        api.sent_away.clear()
        for player, reason in api.kicked:
            self._connections.remove(player, messages.KICKED, reason or "kicked by the game")
        api.kicked.clear()

    def take_inputs(self) -> dict[int, Input]:
        """Takes the input of each player for the coming step, and the inputs that the rules have set.

        An input of the fast path is left out if it is the same as in the tick before, and no pen is attached.
        """
        world, api = self._world, self._api
        tick, players = world.tick + 1, api.players
        if self.fast_path is None:
            inputs = {entity: player.inputs.take(tick) for entity, player in players.items()}
        else:
            inputs = self.fast_path.take(tick, everyone=world.recorded or world.extras.count > 0)
            if len(players) > self._connections.fast:
                others = self._connected()
                if len(players) > self._connections.fast + len(others):  # some have no connection
                    others = [player for player in players.values() if player.row < 0]
                inputs |= {player.entity: player.inputs.take(tick) for player in others}
            if len(inputs) > 1:
                inputs = {entity: inputs[entity] for entity in sorted(inputs)}  # players join with ascending numbers
        if api.steered:
            inputs.update(api.steered)
            api.steered.clear()
        return inputs
