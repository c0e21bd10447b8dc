"""The clients of an edge: their inputs, requests and commands, until a record of the log has them."""

from collections.abc import Mapping
from typing import Any

from server.config.limits import Limits
from server.game.roster import digest_of
from server.game.session import Session
from server.players.input_queue import InputQueue
from server.players.player import Player
from server.scale.wire import LEAVE, LOST
from shared import messages
from shared.bounds import Bounds
from shared.inputs import NEUTRAL, Input
from shared.messages import IDLE, NEUTRALISED, REPEATED, USED, Command


class EdgeInputs(InputQueue):
    """The inputs of one player at an edge. Their statuses wait for the records of their ticks.

    Args:
        bounds, row_bytes: as for `InputQueue`.
        held: the input that the player's entity had before, which stands in for missing ones.
        resumed: whether the player was in the world before, so that an input is expected for every tick.
    """

    def __init__(self, bounds: Bounds, row_bytes: int, held: Input, *, resumed: bool) -> None:
        super().__init__(bounds, row_bytes)
        self.held, self._idle = held, REPEATED if resumed else IDLE
        if resumed:
            self.statuses.append(REPEATED)  # for the tick of the seat
        self.unrecorded: dict[int, tuple[int, Input]] = {}
        self.in_time = 0
        """Number of ticks in a row whose own inputs were in time, up to the newest tick."""
        self.switching = False
        """Whether the change of the player to this edge was asked for."""

    def take(self, tick: int) -> Input:
        input_ = super().take(tick)
        status = self.statuses.pop()
        self.unrecorded[tick] = status, input_
        self.in_time = self.in_time + 1 if status == USED else 0
        return input_

    def _margin(self, at: int, tick: int, ahead: float) -> int:
        if at <= tick:
            self.in_time = 0  # the input before may have held, so that none was missing
        return super()._margin(at, tick, ahead)

    def restart(self, at: int) -> None:
        """Removes the inputs for tick `at` and later.

        The sequencer still uses an input that is in a batch already. The statuses report
        to the client that its own input was missing in that tick.
        """
        for tick in [tick for tick, (status, _) in self.unrecorded.items() if tick >= at and status == USED]:
            self.unrecorded[tick] = REPEATED, self.unrecorded[tick][1]
            self.used -= 1
            self.substituted += 1
        super().restart(at)

    def skip(self, tick: int) -> None:
        """Drops the status of a tick for which another edge had the input."""
        self.unrecorded.pop(tick, None)
        self._pass(tick)

    def confirm(self, tick: int, missing: int, given: Input | None = None) -> None:
        """Files the status of a tick whose record has come.

        Args:
            tick: the tick.
            missing: ticks from the newest batch in the record to the tick; 0: the input was used.
            given: the input that the sequencer used, if it may be another one; None: it is not.
        """
        self._pass(tick)
        status, input_ = self.unrecorded.pop(tick, (IDLE, NEUTRAL))
        if status == IDLE:
            status = self._idle
        if (missing or (given is not None and given != input_)) and status != IDLE:
            self.used -= status == USED
            self.substituted += status == USED
            status = REPEATED if self._bounds.stands_in(missing) else NEUTRALISED
        self.statuses.append(status)
        if len(self.statuses) > self._bounds.statuses:
            del self.statuses[0]

    def _pass(self, tick: int) -> None:
        """Takes an input like a late one if the record of its tick came before the edge took inputs for that tick."""
        if tick in self.waiting:
            self.held, self.missing = self.waiting.pop(tick), 0


class EdgeRoster:
    """The requests of the clients of an edge about their players, in the place of a roster.

    Args:
        players: all players of the world by entity.
    """

    def __init__(self, players: Mapping[int, Player]) -> None:
        self._players = players
        self.requests: list[list[Any]] = []
        self.clients: dict[Session, int] = {}
        """Clients that have asked to join, with their numbers."""
        self.mine: set[int] = set()
        """Players whose latest connection was one to this edge."""

    def lost(self, session: Session, now: float) -> None:
        """Reports a lost connection."""
        self._report(LOST, session)

    def dismiss(self, session: Session) -> None:
        """Reports a client that has left, or that may not come back."""
        self._report(LEAVE, session)

    def knows(self, token: bytes, subject: str) -> bool:
        """Returns whether a player has a resume token and a subject."""
        wanted = digest_of(token)
        players = self._players.values() if token else ()
        return any(wanted in player.tokens and player.subject == subject for player in players)

    def excuse(self, seconds: float, now: float) -> None:
        """Does nothing: the sequencer has the times."""

    def _report(self, kind: int, session: Session) -> None:
        client = self.clients.pop(session, None)
        if session.beside and session.player is not None:
            self.mine.discard(session.player.entity)
        if client is not None:
            self.requests.append([kind, client])
        if session.player is not None and session.player.session is session:
            session.player.session = None


class EdgeCommands:
    """The commands of the clients of an edge, until their ticks."""

    def __init__(self, limits: Limits, ahead: int) -> None:
        self._limits, self._ahead = limits, ahead
        self.newest = -1
        """Newest tick whose inputs were taken."""

    def file(self, player: Player, command: Command) -> None:
        """Queues a command that has arrived. The verdict of an answered one is sent again."""
        if command.number in player.settled:
            player.verdicts.append((command.number, player.settled[command.number]))
        elif any(each.number == command.number for each in player.commands):
            return  # the client has sent it again over a second connection
        elif len(player.commands) >= self._limits.commands_waiting_max or command.tick > self.newest + self._ahead:
            player.verdicts.append((command.number, messages.TOO_MANY))
        else:
            player.commands.append(command)
