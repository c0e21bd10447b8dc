"""What the rules of a game can do and see: `self.game` of `server.rules.Rules`.

Everything here acts at once on the one world, ahead of the step of the coming tick, and through the same functions as
everybody else; so it is sent, recorded and replayed like all that happens.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from random import Random
from types import MappingProxyType
from typing import Any

import numpy as np

from server import values
from server.contacts import Contacts
from server.counters import Counters
from server.faults import Faults
from server.keeping import LEFT, SAID, SHARED, Kept
from server.recorder import RecordedWorld
from server.replication import ChangeLog
from server.rewind import Past, Rewind
from server.rules import Rules, RulesError, check_rules, checked_function, checked_result
from server.session import Player, Session
from server.turn import OutOfTurnError, Turn
from server.values import ATTRIBUTES_MAX as ATTRIBUTES_MAX
from shared import messages
from shared.checks import SceneError, Vec, finite, shown, text, whole
from shared.edits import Edit
from shared.inputs import Input, make_input
from shared.layout import TEMPLATE
from shared.messages import ENTITY_MAX, Command, Happened, ProtocolError, Shared, encode, pack_value, unpack_value
from shared.scene import Scene

SOON_MAX = 10_000
"""The most functions that wait for the next tick."""

TRUTH = (bool, np.bool_)
_FAILED = object()


class Stage:
    """One running game, as its rules see it. Positions in blocks, velocities in blocks/s.

    A method that is given the number of an entity that is not there raises `MissingError` (a `KeyError`); one that is
    given a wrong value raises `SceneError`, which names the field and the value. Nothing has been done then.

    What changes the game may be called within a tick: by the hooks of the rules, and by what `soon` was given. From
    another thread, or from a callback of an event loop, it raises `OutOfTurnError`.
    """

    def __init__(
        self,
        world: RecordedWorld,
        rewind: Rewind,
        counters: Counters,
        rules: Rules,
        *,
        kept: Kept | None = None,
        seed: int = 0,
    ) -> None:
        check_rules(rules)
        self.turn = Turn()
        self._soon: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self.kept = kept or Kept({}, {}, {})
        self.players = self.kept.players
        """Who plays, by entity, in the order in which they joined; also who is cut off and may come back."""
        self.steered: dict[int, Input] = {}
        self._attributes = self.kept.attributes
        self.log = ChangeLog(world, self._attributes)
        self._world, self._rewind, self._counters, self._rules, self._seed = world, rewind, counters, rules, seed
        self._shared = self.kept.shared
        self._version = int(bool(self._shared))
        self._shared_message = encode(Shared(self._shared))
        self._random = (-1, Random())
        self._seen = 0.0
        self._outgoing: list[tuple[frozenset[int] | None, bytes]] = []
        self._contacts = Contacts(world, goes_on=kept is not None)
        self._told_contacts = _overrides(rules, "on_contact")
        self._started = kept is not None
        self._faults = Faults("the rules have failed")
        rules.game = self

    # -- the world -----------------------------------------------------------------------------------------

    @property
    def scene(self) -> Scene:
        """The rules of the physics, and the templates."""
        return self._world.scene

    @property
    def tick(self) -> int:
        """The tick that is about to be computed."""
        return self._world.tick + 1

    def ticks(self, seconds: float) -> int:
        """Returns the number of ticks in some seconds, rounded."""
        return round(finite(seconds, "seconds") * self.scene.tick_rate)

    @property
    def random(self) -> Random:
        """A source of randomness that is the same again in the same tick of a game with the same seed."""
        self.turn.check("random")
        if self._random[0] != self.tick:
            self._random = (self.tick, Random((self._seed << 64) | self.tick))
        return self._random[1]

    def entities(self, template: str | None = None) -> list[int]:
        """The ids of all entities, or of those of a template, ascending."""
        states = self._world.states()
        if template is not None:
            states = states[states[:, TEMPLATE] == self.scene.template(template)]
        ids: list[int] = states[:, 0].tolist()
        return ids

    def __contains__(self, entity: object) -> bool:
        return entity in self._world

    def position(self, entity: int) -> Vec:
        """Where an entity is."""
        return self._world.position(self._known(entity))

    def velocity(self, entity: int) -> Vec:
        """How fast an entity is."""
        return self._world.velocity(self._known(entity))

    def touching(self, entity: int) -> list[int]:
        """The ids of those whose boxes share at least a point with that of an entity, ascending: now, not only anew."""
        return self._contacts.of(self._known(entity))

    def template(self, entity: int) -> str:
        """What an entity is."""
        return self.scene.templates[self._world.state(self._known(entity))[TEMPLATE]].name

    def spawn(self, template: str, position: Vec, velocity: Vec = (0.0, 0.0, 0.0), **attributes: Any) -> int:
        """Adds an entity and returns its id.

        Raises:
            OverlapError: the place, and all near it, is taken.
            SceneError: there is no such template, or a value is out of range.
        """
        self.turn.check("spawn")
        said: Mapping[str, Any] = {}
        for name, value in attributes.items():
            said = values.with_value(said, name, values.checked(name, value), f"template {template!r}")
        entity = self._world.spawn(template, position, velocity, push=True)
        if said:
            self._say(entity, said)
        return entity

    def remove(self, entity: int) -> None:
        """Takes an entity out of the world.

        Raises:
            SceneError: it is a player's.
        """
        self.turn.check("remove")
        entity = self._known(entity)
        if entity in self.players:
            raise SceneError(f"entity = {entity}: is a player's, and stays until the player leaves")
        self._remove(entity)

    def place(self, entity: int, position: Vec) -> None:
        """Puts an entity somewhere else, or as near to it as there is room within a block; its velocity stays.

        Raises:
            OverlapError: there is none.
        """
        self.turn.check("place")
        self._world.place(self._known(entity), position, push=True)

    def throw(self, entity: int, velocity: Vec) -> None:
        """Sets how fast an entity is; one that walks keeps only the upward part beyond the next tick."""
        self.turn.check("throw")
        entity = self._known(entity)
        self._world.set_velocity(entity, velocity)
        self.log.note_act(entity)

    def change(self, entity: int, template: str) -> None:
        """Makes an entity one of another template, where it stands.

        Raises:
            OverlapError: its new box has no room there.
        """
        self.turn.check("change")
        entity = self._known(entity)
        self._world.set_template(entity, template)
        self.log.note_act(entity)

    def steer(self, entity: int, x: float, y: float, *, jump: bool = False) -> None:
        """What an entity that is no player's wishes from now on: a direction (east, north), and whether to jump.

        Raises:
            SceneError: it is a player's.
        """
        self.turn.check("steer")
        entity = self._known(entity)
        if entity in self.players:
            raise SceneError(f"entity = {entity}: is a player's, and goes where the player wants")
        self.steered[entity] = make_input(x, y, jump=jump)

    def block(self, x: int, y: int, z: int) -> int:
        """The kind of a block; 0: there is none."""
        return self._world.block(x, y, z) or 0

    def set_block(self, x: int, y: int, z: int, kind: int) -> None:
        """Places (kind 1 to 255) or removes (0) a block.

        Raises:
            OverlapError: an entity is in the way.
            SceneError: there is no such place, or kind.
        """
        self.turn.check("set_block")
        if self._world.set_block(x, y, z, kind):
            self.log.note_edit(int(x), int(y), int(z))

    def rewound(self, player: Player, seen: float | None = None) -> Past:
        """The world as a player saw it, at most 250 ms ago: answers rays and boxes.

        Args:
            seen: the tick at which that client drew the others; None: what its command says, within `on_command`.
        """
        if not isinstance(player, Player):
            raise SceneError(f"player = {shown(player)}: must be a `Player`, as hooks are given one")
        seen = None if seen is None else finite(seen, "seen")
        gaps = player.session.gaps if player.session is not None else ()
        return self._rewind.at(self._seen if seen is None else seen, player.entity, gaps)

    # -- what the players are told ---------------------------------------------------------------------------

    def set(self, entity: int, name: str, value: Any) -> None:
        """Says something of an entity to all who see it: a small MessagePack value. None: nothing any more.

        It is told as it is now: who changes a list later has to say so again.

        Raises:
            SceneError: more than 32 attributes, or more than 256 bytes.
        """
        self.turn.check("set")
        entity = self._known(entity)
        before, payload = self._attributes.get(entity, {}), values.checked(name, value)
        if payload != values.packed(before.get(name)):
            self._say(entity, values.with_value(before, name, payload, f"entity {entity}"))

    def get(self, entity: int, name: str, default: Any = None) -> Any:
        """What has been said of an entity; a list or a table is a copy."""
        said = self._attributes.get(self._number(entity), {})
        return values.copied(said.get(text(name, "name", messages.NAME_MAX), default))

    @property
    def shared(self) -> Mapping[str, Any]:
        """The values that all clients know, a copy."""
        return MappingProxyType({name: values.copied(value) for name, value in self._shared.items()})

    def share(self, name: str, value: Any) -> None:
        """Tells all clients, also those who join later, a value of the game: the time left, a score. None: no more.

        It is told as it is now: who changes a list later has to say so again.

        Raises:
            SceneError: more than 32 values, or more than 256 bytes.
        """
        self.turn.check("share")
        payload = values.checked(name, value)
        if payload == values.packed(self._shared.get(name)):
            return
        after = values.with_value(self._shared, name, payload, "the game")
        self._shared.clear()
        self._shared.update(after)
        self._world.note([SHARED, after])
        self._version += 1
        self._shared_message = encode(Shared(self._shared))

    def send(self, name: str, data: Any = None, to: Player | Iterable[Player] | None = None) -> None:
        """Tells one player, some or (None) all that something has happened: `Happened` in the client.

        Raises:
            SceneError: the name is longer than 32 characters, the data than 1,024 bytes as MessagePack.
        """
        self.turn.check("send")
        text(name, "name", messages.NAME_MAX)
        try:
            payload = pack_value(data)
        except ValueError as error:
            raise SceneError(f"send {name!r}: data = {error}") from error
        entities = None if to is None else _entities_of(to)
        self._outgoing.append((entities, encode(Happened(self.tick, name, payload))))

    def soon(self, act: Callable[..., object], *arguments: Any) -> None:
        """Calls a function within the next tick, ahead of the other hooks: the way into a game from elsewhere.

        May be called at any time and from any thread, callbacks of asyncio included. The functions are called in the
        order in which they came. One that raises is reported and counted as a failing hook is.

        Args:
            act: the function.
            arguments: are handed to it.

        Raises:
            OutOfTurnError: 10,000 functions wait already: the game does not tick.
            RulesError: it is none, or is async.
        """
        checked_function(act, "soon: act")
        if len(self._soon) >= SOON_MAX:
            raise OutOfTurnError(f"soon: {SOON_MAX} functions wait already; does the game tick?")
        self._soon.append((act, arguments))

    # -- what the game calls -----------------------------------------------------------------------------------

    def joined(self, player: Player) -> None:
        """A player has an entity."""
        if player.name:
            self.set(player.entity, "name", player.name)
        player.announced = True
        self._call(self._rules.on_join, player)

    def left(self, player: Player) -> None:
        """A player leaves, and the entity with it, if the rules have not removed that already."""
        if player.announced:
            self._call(self._rules.on_leave, player)
        if player.entity in self._world:
            self._remove(player.entity)

    def fell_out(self, entity: int) -> bool:
        """Whether the rules have seen to an entity that is below the floor."""
        seen_to = self._call(self._rules.on_fell_out, entity)
        return (isinstance(seen_to, TRUTH) and bool(seen_to)) or entity not in self._world

    def command(self, player: Player, command: Command) -> int:
        """Has the rules carry out a command; the verdict."""
        try:
            payload = unpack_value(command.payload)
        except ProtocolError:
            return messages.INVALID
        self._seen = command.seen
        if not _overrides(self._rules, "on_command"):
            return messages.INVALID
        done = self._call(self._rules.on_command, player, command.name, payload, failed=_FAILED)
        if done is _FAILED:
            return messages.FAILED
        return messages.FORBIDDEN if isinstance(done, TRUTH) and not done else messages.DONE

    def may_edit(self, player: Player, edit: Edit) -> bool:
        """Whether the rules allow an edit; not, if they fail."""
        return bool(self._call(self._can_edit, player, edit, failed=False))

    def _can_edit(self, player: Player, edit: Edit) -> object:
        allowed: object = self._rules.can_edit(player, *edit)
        if allowed is None:
            raise RulesError("can_edit returned None: it must return True or False")
        return checked_result(allowed, "can_edit")

    def start(self) -> None:
        """Tells the rules, once in a game's life, that the world is there; and does what was to be done soon."""
        if not self._started:
            self._started = True
            self._call(self._rules.on_start)
        for _ in range(len(self._soon)):  # what they hand over in turn is for the tick after
            act, arguments = self._soon.popleft()
            self._call(act, *arguments)

    def act(self) -> None:
        """The part of the rules in a tick that nobody asks for."""
        for a, b in self._contacts.begun() if self._told_contacts else ():
            if a in self._world and b in self._world:
                self._call(self._rules.on_contact, a, b)
        self._call(self._rules.on_tick)

    def stepped(self) -> None:
        """The step is over."""
        if self._told_contacts:
            self._contacts.stepped()

    def tell(self, most: int) -> None:
        """Queues the events of this tick for the players, at most `most` for each; also for those who are away."""
        for entities, message in self._outgoing:
            for entity in self.players if entities is None else entities & self.players.keys():
                player = self.players[entity]
                if player.inputs.wheel is None:  # to a player inside the server, nothing is sent
                    self._counters.events_dropped += player.outbox.add(self._world.tick, message, most)
        self._outgoing.clear()

    def show(self, session: Session) -> None:
        """Files the shared values for a client, if it does not have them as they are."""
        if session.shared != self._version:
            session.shared = self._version
            session.shared_due = self._shared_message

    def _say(self, entity: int, attributes: Mapping[str, Any]) -> None:
        self._attributes[entity] = dict(attributes)
        self.log.note_attributes(entity)
        self._world.note([SAID, entity, attributes])

    def _remove(self, entity: int) -> None:
        self._world.remove(entity)
        self._world.note([LEFT, entity])
        self._attributes.pop(entity, None)
        self.steered.pop(entity, None)
        self.log.note_removal(entity)

    def _number(self, entity: object) -> int:
        """The number of an entity, as Python's own."""
        if isinstance(entity, Player):
            raise SceneError(f"entity = {shown(entity)}: is a player; its entity is `player.entity`")
        return whole(entity, "entity", 1, ENTITY_MAX)

    def _known(self, entity: object) -> int:
        """The number of an entity that is there."""
        number = self._number(entity)
        self._world.awake(number)  # raises where it is not
        return number

    def _call(self, hook: Any, *arguments: Any, failed: Any = None) -> Any:
        """Calls a hook; where it raises, that is counted, and `failed` is the answer."""
        try:
            return checked_result(hook(*arguments), getattr(hook, "__name__", "a function"))
        except Exception:
            self._counters.rules_failed += 1
            self._faults.report(getattr(hook, "__qualname__", repr(hook)))
            return failed


def _overrides(rules: Rules, name: str) -> bool:
    return getattr(type(rules), name) is not getattr(Rules, name)


def _entities_of(to: object) -> frozenset[int]:
    """The entities of a player, or of some."""
    players = [to] if isinstance(to, Player) else list(to) if isinstance(to, Iterable) else [None]
    if not all(isinstance(player, Player) for player in players):
        raise SceneError(f"to = {shown(to)}: must be a `Player`, some of them, or None for all")
    return frozenset(player.entity for player in players if isinstance(player, Player))
