"""Commands of players: queued when they arrive, and carried out in their tick. `server.game.answers` answers them."""

from server.config.limits import Limits
from server.game_api.api import GameApi
from server.journal.recorded_world import RecordedWorld, Saves
from server.observability.errors import FaultReporter
from server.players import persisted_state
from server.players.player import Player
from shared import edits, messages
from shared.bounds import bounds
from shared.messages import Command


class Commands:
    """The commands of all players of one game.

    Args:
        world: the world.
        api: the game API, which calls the rules.
        limits: the limits.
        faults: where exceptions in commands are reported.
        saves: the store of the world; None: the world is not saved.
    """

    def __init__(
        self, world: RecordedWorld, api: GameApi, limits: Limits, faults: FaultReporter, saves: Saves | None = None
    ) -> None:
        self._world, self._api, self._limits, self._faults, self._saves = world, api, limits, faults, saves
        self._ahead = bounds(world.scene.tick_rate).ahead
        self._edits_max = 2 * limits.edits_per_s
        self._edits_per_tick = limits.edits_per_s / world.scene.tick_rate
        self._waiting = False
        """Whether a player may have commands that wait."""

    @property
    def trouble(self) -> bool:
        """Whether nothing can be saved at the moment."""
        return self._saves is not None and bool(self._saves.trouble)

    @property
    def durable_tick(self) -> int:
        """Newest tick that no crash can undo."""
        return self._world.tick if self._saves is None else self._saves.durable_tick

    def file(self, player: Player, command: Command) -> None:
        """Queues a command that has arrived. A known command is not queued again; its verdict is sent again."""
        if command.number <= player.command:
            if command.number in player.settled:  # the client has sent it again after a lost connection
                player.verdicts.append((command.number, player.settled[command.number]))
            return
        player.command = command.number
        if len(player.commands) >= self._limits.commands_waiting_max or command.tick > self._world.tick + self._ahead:
            player.settle(command.number, messages.TOO_MANY)
        else:
            player.commands.append(command)
            self._waiting = True

    def carry_out(self) -> None:
        """Carries out the due commands of all players, in the order in which the players joined."""
        if not self._waiting:
            return
        tick = self._world.tick + 1
        for player in tuple(self._api.players.values()):
            while player.commands and player.commands[0].tick <= tick:
                if player.session is not None and player.session.closed:
                    break
                command = player.commands.popleft()
                if self.trouble:
                    player.settle(command.number, messages.UNSAVED)
                    continue
                self._api.hooks.reason = ""
                try:
                    verdict = self._verdict(player, command)
                except Exception:
                    self._faults.report("a command")
                    verdict = messages.FAILED
                reason = self._api.hooks.reason
                self._api.outcome.verdicts.append((player.entity, command.number, verdict, reason))
                self._world.note(persisted_state.note_of_answer(player.entity, command.number, verdict, reason))
        self._waiting = any(player.commands for player in self._api.players.values())

    def _verdict(self, player: Player, command: Command) -> int:
        if command.name != edits.NAME:
            return self._api.hooks.command(player, command)
        edit = edits.unpack(command.payload)
        if edit is None:
            return messages.INVALID
        self._refill(player)
        if player.edits_left < 1:
            return messages.TOO_MANY
        player.edits_left -= 1
        if not self._api.hooks.may_edit(player, edit):
            return messages.FORBIDDEN
        return edits.apply(self._world, player.entity, edit)

    def _refill(self, player: Player) -> None:
        """Adds the edits of the ticks since the latest call to those that a player may do now."""
        tick = self._world.tick + 1
        left, most = min(player.edits_left, self._edits_max), self._edits_max
        for _ in range(player.edits_tick, tick):
            if left == most:
                break
            left = min(left + self._edits_per_tick, most)
        player.edits_left, player.edits_tick = left, tick
