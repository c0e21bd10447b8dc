"""What the rules of a game can do and see: `self.game` of `server.rules.Rules`.

Everything here acts at once on the one world, ahead of the step of the coming tick, and through the same functions as
everybody else; so it is sent, recorded and replayed like all that happens.
"""

from collections.abc import Iterable, Mapping
from random import Random
from types import MappingProxyType
from typing import Any

import msgpack

from server.contacts import Contacts
from server.counters import Counters
from server.faults import Faults
from server.keeping import LEFT, SAID, SHARED, Kept
from server.recorder import RecordedWorld
from server.replication import ChangeLog
from server.rewind import Past, Rewind
from server.rules import Rules
from server.session import Player, Session
from shared import messages
from shared.checks import SceneError, Vec, text
from shared.edits import Edit
from shared.inputs import Input, make_input
from shared.layout import TEMPLATE
from shared.messages import Command, Happened, ProtocolError, Shared, encode, pack_value, unpack_value
from shared.scene import Scene

ATTRIBUTES_MAX = 32
"""So many attributes an entity may have, and so many values the game may share,"""
VALUE_BYTES_MAX = 256
"""each of at most so many bytes as MessagePack."""

_FAILED = object()


class Stage:
    """One running game, as its rules see it. Positions in blocks, velocities in blocks/s.

    Methods that name an entity raise `KeyError` if there is none of that id; those that take values, `SceneError`.
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
        """So many seconds in ticks, rounded."""
        return round(seconds * self.scene.tick_rate)

    @property
    def random(self) -> Random:
        """A source of randomness that is the same again in the same tick of a game with the same seed."""
        if self._random[0] != self.tick:
            self._random = (self.tick, Random((self._seed << 64) | self.tick))
        return self._random[1]

    def entities(self, template: str | None = None) -> list[int]:
        """The ids of all entities, or of those of a template, ascending."""
        states = self._world.states()
        if template is not None:
            states = states[states[:, TEMPLATE] == self._number(template)]
        ids: list[int] = states[:, 0].tolist()
        return ids

    def __contains__(self, entity: int) -> bool:
        return entity in self._world

    def position(self, entity: int) -> Vec:
        """Where an entity is."""
        return self._world.position(entity)

    def velocity(self, entity: int) -> Vec:
        """How fast an entity is."""
        return self._world.velocity(entity)

    def touching(self, entity: int) -> list[int]:
        """The ids of those whose boxes share at least a point with that of an entity, ascending: now, not only anew."""
        self._world.state(entity)
        return self._contacts.of(entity)

    def template(self, entity: int) -> str:
        """What an entity is."""
        return self.scene.templates[self._world.state(entity)[TEMPLATE]].name

    def spawn(self, template: str, position: Vec, velocity: Vec = (0.0, 0.0, 0.0), **attributes: Any) -> int:
        """Adds an entity and returns its id.

        Raises:
            OverlapError: the place, and all near it, is taken.
            SceneError: there is no such template, or a value is out of range.
        """
        said: Mapping[str, Any] = {}
        for name, value in attributes.items():
            said = _with(said, name, _checked(name, value), template)
        entity = self._world.spawn(template, position, velocity, push=True)
        if said:
            self._say(entity, said)
        return entity

    def remove(self, entity: int) -> None:
        """Takes an entity out of the world.

        Raises:
            SceneError: it is a player's.
        """
        if entity in self.players:
            raise SceneError(f"entity {entity}: is a player's, and stays until the player leaves")
        self._remove(entity)

    def place(self, entity: int, position: Vec) -> None:
        """Puts an entity somewhere else, or as near to it as there is room within a block; its velocity stays.

        Raises:
            OverlapError: there is none.
        """
        self._world.place(entity, position, push=True)

    def throw(self, entity: int, velocity: Vec) -> None:
        """Sets how fast an entity is; one that walks keeps only the upward part beyond the next tick."""
        self._world.set_velocity(entity, velocity)
        self.log.note_act(entity)

    def change(self, entity: int, template: str) -> None:
        """Makes an entity one of another template, where it stands.

        Raises:
            OverlapError: its new box has no room there.
        """
        self._world.set_template(entity, template)
        self.log.note_act(entity)

    def steer(self, entity: int, x: float, y: float, *, jump: bool = False) -> None:
        """What an entity that is no player's wishes from now on: a direction (east, north), and whether to jump.

        Raises:
            SceneError: it is a player's.
        """
        if entity in self.players:
            raise SceneError(f"entity {entity}: is a player's, and goes where the player wants")
        if entity not in self._world:
            raise KeyError(entity)
        self.steered[entity] = make_input(x, y, jump=jump)

    def block(self, x: int, y: int, z: int) -> int:
        """The kind of a block; 0: there is none."""
        return self._world.blocks.get(x, y, z) or 0

    def set_block(self, x: int, y: int, z: int, kind: int) -> None:
        """Places (kind 1 to 255) or removes (0) a block.

        Raises:
            OverlapError: an entity is in the way.
            SceneError: there is no such place, or kind.
        """
        self._world.set_block(x, y, z, kind)
        self.log.note_edit(x, y, z)

    def rewound(self, player: Player, seen: float | None = None) -> Past:
        """The world as a player saw it, at most 250 ms ago: answers rays and boxes.

        Args:
            seen: the tick at which that client drew the others; None: what its command says, within `on_command`.
        """
        gaps = player.session.gaps if player.session is not None else ()
        return self._rewind.at(self._seen if seen is None else seen, player.entity, gaps)

    # -- what the players are told ---------------------------------------------------------------------------

    def set(self, entity: int, name: str, value: Any) -> None:
        """Says something of an entity to all who see it: a small MessagePack value. None: nothing any more.

        It is told as it is now: who changes a list later has to say so again.

        Raises:
            SceneError: more than 32 attributes, or more than 256 bytes.
        """
        if entity not in self._world:
            raise KeyError(entity)
        before, packed = self._attributes.get(entity, {}), _checked(name, value)
        if packed != _packed(before.get(name)):
            self._say(entity, _with(before, name, packed, f"entity {entity}"))

    def get(self, entity: int, name: str, default: Any = None) -> Any:
        """What has been said of an entity; a list or a table is a copy."""
        return _copied(self._attributes.get(entity, {}).get(name, default))

    @property
    def shared(self) -> Mapping[str, Any]:
        """The values that all clients know, a copy."""
        return MappingProxyType({name: _copied(value) for name, value in self._shared.items()})

    def share(self, name: str, value: Any) -> None:
        """Tells all clients, also those who join later, a value of the game: the time left, a score. None: no more.

        It is told as it is now: who changes a list later has to say so again.

        Raises:
            SceneError: more than 32 values, or more than 256 bytes.
        """
        packed = _checked(name, value)
        if packed == _packed(self._shared.get(name)):
            return
        after = _with(self._shared, name, packed, "the game")
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
        text(name, "name", messages.NAME_MAX)
        try:
            payload = pack_value(data)
        except ValueError as error:
            raise SceneError(f"send {name!r}: data = {error}") from error
        players = (to,) if isinstance(to, Player) else to
        entities = None if players is None else frozenset(player.entity for player in players)
        self._outgoing.append((entities, encode(Happened(self.tick, name, payload))))

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
        return self._call(self._rules.on_fell_out, entity) is True or entity not in self._world

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
        return messages.FORBIDDEN if done is False else messages.DONE

    def may_edit(self, player: Player, edit: Edit) -> bool:
        """Whether the rules allow an edit; not, if they fail."""
        return self._call(self._rules.can_edit, player, *edit, failed=False) is not False

    def start(self) -> None:
        """Tells the rules, once in a game's life, that the world is there."""
        if not self._started:
            self._started = True
            self._call(self._rules.on_start)

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

    def _number(self, template: str) -> int:
        try:
            return self.scene.index_of[template]
        except KeyError:
            raise SceneError(f"template {template!r}: the scene has none of that name") from None

    def _call(self, hook: Any, *arguments: Any, failed: Any = None) -> Any:
        """Calls a hook; where it raises, that is counted, and `failed` is the answer."""
        try:
            return hook(*arguments)
        except Exception:
            self._counters.rules_failed += 1
            self._faults.report(hook.__qualname__)
            return failed


def _overrides(rules: Rules, name: str) -> bool:
    return getattr(type(rules), name) is not getattr(Rules, name)


def _checked(name: str, value: Any) -> bytes:
    """A value that may be told, packed."""
    text(name, "name", messages.NAME_MAX)
    try:
        packed = pack_value(value)
    except ValueError as error:
        raise SceneError(f"{name} = {error}") from error
    if len(packed) > VALUE_BYTES_MAX:
        raise SceneError(f"{name}: a value of {len(packed)} bytes; at most {VALUE_BYTES_MAX}")
    return packed


def _packed(value: Any) -> bytes:
    """A value that has been told: those that are equal in Python (1, True and 1.0) are not the same to a client."""
    return msgpack.packb(value)  # type: ignore[no-any-return]


def _copied(value: Any) -> Any:
    """What nobody can change behind our back."""
    return unpack_value(_packed(value)) if isinstance(value, list | dict) else value


def _with(values: Mapping[str, Any], name: str, packed: bytes, whose: str) -> dict[str, Any]:
    """A new table with one value more, another one, or (None) one less."""
    value = unpack_value(packed)
    after = {**values, name: value}
    if value is None:
        del after[name]
    if len(after) > ATTRIBUTES_MAX:
        raise SceneError(f"{whose}: more than {ATTRIBUTES_MAX} values")
    return after
