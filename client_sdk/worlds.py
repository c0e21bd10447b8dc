"""The worlds of a client: the replica that the server's messages fill, and the input loop in a complete one.

joining            the welcome makes a replica; snapshots, terrain and pongs complete it
playing            the messages and the input loop use the same replica
after a reconnect  the messages fill a second replica; the input loop uses the old one until the second is complete
"""

from collections import deque
from collections.abc import Sequence

from client_sdk.commands import SentCommands
from client_sdk.controls import Controls
from client_sdk.input_loop import RECONNECTED, InputLoop
from client_sdk.pending_events import PendingEvents
from client_sdk.replica import Replica
from client_sdk.stats import Stats
from client_sdk.timing.server_clock import ServerClock
from shared import kernels
from shared.behaviours import Behaviour
from shared.messages import Announce, Message, Pong, ProtocolError, Snapshot, Welcome
from shared.turns import Announcement


class Worlds:
    """The replicas and the input loop of one client.

    Args:
        stats: counters to update.
        events: receives the events.
        controls: where the input delay is set.
        behaviours: this program's classes of the game's behaviours.
        compiled: whether the kernel is compiled, as for `Core`.
        neighbours: whether the predicted world has other entities, as for `Core`.
    """

    def __init__(
        self,
        stats: Stats,
        events: PendingEvents,
        controls: Controls,
        behaviours: Sequence[type[Behaviour]],
        *,
        compiled: bool | None,
        neighbours: bool,
    ) -> None:
        self.filled: Replica | None = None
        """The replica that receives the messages of the current connection; None before its welcome."""
        self.play: InputLoop | None = None
        """The input loop; None before the client has joined."""
        self.plain_for_now = False
        """Whether the plain kernel is used until the chosen one is ready (`speed_up`)."""
        self._stats, self._events, self._controls = stats, events, controls
        self._compiled, self._neighbours, self._behaviours = compiled, neighbours, behaviours
        self._pings: deque[float] = deque(maxlen=16)
        """Local times at which the unanswered pings were sent, in seconds."""

    @property
    def current(self) -> Replica | None:
        """The replica that the client plays in; before the play, the one that is being filled."""
        return self.play.world if self.play else self.filled

    @property
    def clock(self) -> ServerClock:
        """The clock that the client plays by; before the welcome, a new one."""
        world = self.current
        return world.clock if world else ServerClock()

    @property
    def connection_clock(self) -> ServerClock:
        """The clock that belongs to the current connection; after a reconnect, `play` may still use the old one."""
        return self.filled.clock if self.filled else self.clock

    def welcomed(self, message: Message) -> Replica:
        """Returns the replica that a message is for.

        Raises:
            ProtocolError: there was no welcome before the message.
        """
        if self.filled is None:
            raise ProtocolError(f"unexpected {type(message).__name__} message before Welcome")
        return self.filled

    def replica(self, welcome: Welcome, now: float) -> Replica:
        """Makes the replica that a welcome begins. It is not in use yet.

        Raises:
            ProtocolError: the welcome is malformed.
            BehaviourError: the scene needs behaviours that this program does not have.
        """
        self.plain_for_now = self._compiled is None and not kernels.ready()
        compiled = False if self.plain_for_now else self._compiled
        world = Replica(
            welcome,
            self.clock,
            now,
            controls=self._controls,
            behaviours=self._behaviours,
            neighbours=self._neighbours,
            compiled=compiled,
        )
        self._stats.kernel = "plain for now" if self.plain_for_now else world.confirmed.world.kernel.form
        return world

    def speed_up(self) -> None:
        """Replaces the plain kernel by the chosen one if that is ready now."""
        if not kernels.ready():
            return
        self.plain_for_now = False
        kernel = kernels.get()
        if self.filled is not None:
            self.filled.use(kernel)
        if self.play is not None and self.play.world is not self.filled:
            self.play.world.use(kernel)
        self._stats.kernel = kernel.form

    def ping_due(self, now: float) -> bool:
        """Returns whether to send a ping now, and counts it as sent if so."""
        due = self.connection_clock.due(now)
        if due:
            self._pings.append(now)
        return due

    def answered(self, pong: Pong, now: float) -> None:
        """Takes the answer to a ping. Ignores one that does not answer a ping of this client."""
        if pong.sent not in self._pings:
            return
        self._pings.remove(pong.sent)
        self._stats.pinged(max(now - pong.sent, 0.0))
        self._stepped(self.connection_clock.answered(pong.sent, pong.tick, now), now)
        if self.play:
            self.play.answered(pong.sent)

    def snapshot(self, snapshot: Snapshot, commands: SentCommands, now: float) -> None:
        """Takes a snapshot: what became of inputs, the results of commands, and the changes of the world.

        Args:
            snapshot: the snapshot.
            commands: the commands that wait for their results.
            now: local time in seconds.

        Raises:
            ProtocolError: the snapshot is malformed, or came before the welcome.
        """
        world, play, stats = self.welcomed(snapshot), self.play, self._stats
        stats.snapshots_skipped += world.skipped(snapshot)
        stats.snapshots += 1
        if play:
            play.learn(snapshot, now)
        for answered in commands.answer(snapshot.verdicts):
            if play:
                play.world.prediction.settle(answered.number, answered.done)
            self._events.append(answered)
        world.apply(snapshot)
        self._stepped(world.clock.seen(snapshot.tick, now), now)

    def announced(self, message: Announce) -> bool:
        """Takes an announcement. Returns whether the program has got it ahead of the server."""
        if self.play is None:
            return False
        prediction = self.play.world.prediction
        if not prediction.entity <= message.entity <= prediction.last_own:
            return False
        event = Announcement(message.entity, message.name, message.payload)
        return prediction.announcements.arrived(message.tick, event)

    def begin(self, world: Replica, now: float) -> tuple[list[Message], bool]:
        """Starts the input loop in a complete replica, for the first time or after a reconnect.

        Returns:
            The messages to send, and whether the own entity is the one from before a reconnect.
        """
        old = self.play
        same = old is not None and world.take_over(old.world)
        if old is None or old.world.clock is not world.clock:
            play = self.play = InputLoop(world, self._stats, self._events, now)
        else:
            play = old
            play.world = world
        messages = play.restart(now, RECONNECTED)
        self._stats.reconnects += old is not None
        return messages + play.unreceived() if same else messages, same

    def change_over(self, world: Replica) -> None:
        """Goes on in a complete replica of the same world with the same clock, without a pause."""
        assert self.play is not None
        old = self.play.world
        world.take_over(old)
        world.prediction.take_place(old.prediction)
        self.filled = self.play.world = world
        self.play.change_over()
        self._pings.clear()

    def restart(self) -> None:
        """Forgets everything of the world, because the client goes to another one."""
        self.filled = self.play = None
        self.plain_for_now = False
        self._pings.clear()

    def _stepped(self, ticks: float, now: float) -> None:
        """Follows a step of the server's time, by `ticks`; 0: there was none."""
        if not ticks:
            return
        self._pings.clear()  # answers to earlier pings describe the time before the step
        play = self.play
        if play and play.world.clock is self.connection_clock:
            play.stepped(ticks, now)
