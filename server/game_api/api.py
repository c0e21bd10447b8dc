"""The game API: `self.game` of `server.rules.Rules`, by which rules read and change a running game.

A change takes effect in the world at once, before the step of the coming tick. It goes through the same functions as
every other change of the world, so it is sent to clients, recorded and replayed like them.
"""

from collections.abc import Callable, Iterable, Mapping
from random import Random
from typing import Any

from server.game_api import attributes as attribute_tables
from server.game_api.attributes import Attributes
from server.game_api.entries import Entries
from server.game_api.hooks import Hooks
from server.game_api.input_api import InputApi
from server.game_api.outgoing import Outgoing
from server.game_api.players_api import PlayersApi
from server.game_api.shared_values import SharedValues
from server.game_api.timers import Timers, TimersApi
from server.game_api.turn import Turn
from server.game_api.turn_results import TurnResults
from server.game_api.values_api import ValuesApi
from server.game_api.zones import Zones
from server.game_api.zones_api import ZonesApi
from server.journal.recorded_world import RecordedWorld
from server.observability.counters import Counters
from server.players.persisted_state import LEFT, PersistedState
from server.players.player import Player
from server.replication.outcome import Outcome
from server.rewind import Rewind
from server.rewind.history import Past
from server.rules import Rules, check_rules
from shared.checks import SceneError, Vec, finite, shown, text
from shared.layout import TEMPLATE
from shared.scene import Scene


class GameApi(InputApi, PlayersApi, TimersApi, ValuesApi, ZonesApi):
    """The game API of one running game. Positions are in blocks, velocities in blocks/s.

    A method raises `MissingError` (a `KeyError`) if there is no entity with the given number, and `SceneError`, which
    names the field and the value, if a value is wrong. In both cases it has changed nothing.

    Methods that change the game may be called within a tick only: from hooks of the rules, and from functions that were
    passed to `soon`. From another thread, or from a callback of an event loop, they raise `OutOfTurnError`.

    Args:
        world: the world of the game.
        rewind: the recent past of the world, for `rewound`.
        counters: where failed hooks and dropped events are counted.
        rules: the rules of the game; their `game` is set to this object.
        kept: the persisted state of a game that is restored; None: a new game.
        seed: seed of `random`.
    """

    def __init__(
        self,
        world: RecordedWorld,
        rewind: Rewind,
        counters: Counters,
        rules: Rules,
        *,
        kept: PersistedState | None = None,
        seed: int = 0,
    ) -> None:
        check_rules(rules)
        self.kept = kept or PersistedState()
        super().__init__(world, self.kept.players, Turn())
        self._init_players()
        self.outcome = Outcome()
        self.shared_values = SharedValues(world, self.kept.shared)
        self.outgoing = Outgoing(self.outcome.events)
        self._rules, self._timers = rules, Timers(Entries(world, self.kept, "timers"))
        self._private, self._subjects = Entries(world, self.kept, "private"), Entries(world, self.kept, "subjects")
        self._zones = Zones(world, Entries(world, self.kept, "zones"))
        self.hooks = Hooks(self, world, rules, counters, self._zones, self._timers, goes_on=kept is not None)
        self._attributes = Attributes(world, self.outcome.attributes, self.kept.attributes)
        self.turn_results = TurnResults(world, self.outcome, self._forget, counters)
        self._rewind, self._seed = rewind, seed
        self._random = (-1, Random())
        rules.game = self

    @property
    def players(self) -> dict[int, Player]:
        """Players by entity, in the order in which they joined.

        Players who have lost their connection and may still reconnect are among them. Do not change the dictionary.
        """
        return self.kept.players

    # -- the world -----------------------------------------------------------------------------------------

    @property
    def scene(self) -> Scene:
        """The scene: tick rate, gravity, templates, spawn points."""
        return self._world.scene

    @property
    def tick(self) -> int:
        """The number of the tick that is about to be computed."""
        return self._world.tick + 1

    def ticks(self, seconds: float) -> int:
        """Returns the number of ticks in a number of seconds, rounded."""
        return round(finite(seconds, "seconds") * self.scene.tick_rate)

    @property
    def random(self) -> Random:
        """A random number generator, seeded anew in each tick with the game's seed and the tick's number.

        A game with the same seed gets the same numbers in the same tick.
        """
        self.turn.check("random")
        if self._random[0] != self.tick:
            self._random = (self.tick, Random((self._seed << 64) | self.tick))
        return self._random[1]

    def entities(self, template: str | None = None) -> list[int]:
        """Returns the numbers of all entities, or of those with a template, in ascending order."""
        states = self._world.states()
        if template is not None:
            states = states[states[:, TEMPLATE] == self.scene.template(template)]
        ids: list[int] = states[:, 0].tolist()
        return ids

    def __contains__(self, entity: object) -> bool:
        return entity in self._world

    def position(self, entity: int) -> Vec:
        """Returns the position (x, y, z) of an entity in blocks."""
        return self._world.position(self._known(entity))

    def velocity(self, entity: int) -> Vec:
        """Returns the velocity (x, y, z) of an entity in blocks/s."""
        return self._world.velocity(self._known(entity))

    def touching(self, entity: int) -> list[int]:
        """Returns the entities that touch an entity now, in ascending order: their boxes share at least a point.

        Unlike the hook `on_contact`, this includes contacts that began earlier.
        """
        return self.hooks.touching(self._known(entity))

    def template(self, entity: int) -> str:
        """Returns the name of an entity's template."""
        return self.scene.templates[self._world.state(self._known(entity))[TEMPLATE]].name

    def field(self, entity: int, name: str) -> int:
        """Returns the value of a field of the behaviour of an entity.

        Raises:
            SceneError: its template has no behaviour, or that has no such field.
        """
        return self._world.field(self._known(entity), text(name, "name"))

    def set_field(self, entity: int, name: str, value: int) -> None:
        """Sets a field of the behaviour of an entity, from this tick on.

        Raises:
            SceneError: there is no such field, or the value is out of its range.
        """
        self.turn.check("set_field")
        entity = self._known(entity)
        self._world.set_field(entity, text(name, "name"), value)
        self.outcome.acted.add(entity)

    def spawn(self, template: str, position: Vec, velocity: Vec = (0.0, 0.0, 0.0), **attributes: Any) -> int:
        """Adds an entity and returns its number.

        Args:
            template: name of its template.
            position: (x, y, z) in blocks. If it is taken, the nearest free place within a block is used.
            velocity: (x, y, z) in blocks/s.
            attributes: attributes of the entity, as for `set`.

        Raises:
            OverlapError: there is no free place at or near the position.
            SceneError: there is no such template, or a value is out of range.
        """
        self.turn.check("spawn")
        checked = attribute_tables.checked(attributes, f"template {template!r}")
        entity = self._world.spawn(template, position, velocity, push=True)
        if checked:
            self._attributes.put(entity, checked)
        return entity

    def remove(self, entity: int) -> None:
        """Removes an entity from the world.

        Raises:
            SceneError: the entity is a player's.
        """
        self.turn.check("remove")
        entity = self._known(entity)
        if entity in self.players:
            raise SceneError(f"entity = {entity}: is a player's and cannot be removed before the player leaves")
        self.discard(entity)

    def place(self, entity: int, position: Vec) -> None:
        """Moves an entity to a position in blocks, or to the nearest free place within a block. Keeps its velocity.

        Raises:
            OverlapError: there is no free place.
        """
        self.turn.check("place")
        self._world.place(self._known(entity), position, push=True)

    def throw(self, entity: int, velocity: Vec) -> None:
        """Sets the velocity of an entity in blocks/s.

        The horizontal part then decays by the acceleration and the friction of the entity's template. An entity that
        walks and has neither keeps only the vertical part beyond the next tick; its input then sets the other two.
        """
        self.turn.check("throw")
        entity = self._known(entity)
        self._world.set_velocity(entity, velocity)
        self.outcome.acted.add(entity)

    def push(self, entity: int, velocity: Vec) -> None:
        """Adds to the velocity of an entity in blocks/s: knockback, an explosion, a jump pad, a dash.

        The horizontal part decays as after `throw`. Each part of the sum is limited to 1024 blocks/s.
        """
        self.turn.check("push")
        entity = self._known(entity)
        self._world.add_velocity(entity, velocity)
        self.outcome.acted.add(entity)

    def change(self, entity: int, template: str) -> None:
        """Changes the template of an entity. Position and velocity stay.

        Raises:
            OverlapError: the box of the new template has no room there.
        """
        self.turn.check("change")
        entity = self._known(entity)
        self._world.set_template(entity, template)
        self.outcome.acted.add(entity)

    def block(self, x: int, y: int, z: int) -> int:
        """Returns the kind of a block: 1 to 255, or 0 for air and for places that are not loaded."""
        return self._world.block(x, y, z) or 0

    def kind(self, name: str) -> int:
        """Returns the number of a named kind of blocks of the scene, for `set_block` and `block`.

        Raises:
            SceneError: there is no such kind.
        """
        return self.scene.kind(name)

    def set_block(self, x: int, y: int, z: int, kind: int) -> None:
        """Places (kind 1 to 255) or removes (0) a block.

        Raises:
            OverlapError: an entity is in the way.
            SceneError: the place is not loaded, or there is no such kind.
        """
        self.turn.check("set_block")
        self._world.set_block(x, y, z, kind)

    def rewound(self, player: Player, seen: float | None = None) -> Past:
        """Returns the world as a player saw it, for queries of rays and boxes (lag compensation).

        It looks back at most `Limits.rewind_s` seconds (0.5 by default).

        Args:
            player: the player. No query finds the player's own entity.
            seen: server time in ticks at which the player's client drew the other entities; None: as the command says
                that is being carried out, for calls within `on_command`.
        """
        if not isinstance(player, Player):
            raise SceneError(f"player = {shown(player)}: must be a `Player`, as hooks get it")
        seen = None if seen is None else finite(seen, "seen")
        gaps = player.session.stream.gaps if player.session is not None else ()
        return self._rewind.at(self.hooks.seen if seen is None else seen, player.entity, gaps)

    # -- what clients receive --------------------------------------------------------------------------------

    def set(self, entity: int, name: str, value: Any) -> None:
        """Sets an attribute of an entity, which is sent to every client that sees the entity.

        The value is sent as it is now. If you change a list later, call `set` again.

        Args:
            entity: number of the entity.
            name: name of the attribute, 1 to 32 characters.
            value: any MessagePack value of at most 256 bytes; None removes the attribute.

        Raises:
            SceneError: the entity would have more than 32 attributes, or the value has more than 256 bytes.
        """
        self.turn.check("set")
        self._attributes.set(self._known(entity), name, value)

    def get(self, entity: int, name: str, default: Any = None) -> Any:
        """Returns an attribute of an entity, or `default` if it is not set. A list or a table is a copy."""
        return self._attributes.get(self._number(entity), name, default)

    @property
    def shared(self) -> Mapping[str, Any]:
        """The shared values of the game by name, as a copy."""
        return self.shared_values.copy()

    def share(self, name: str, value: Any) -> None:
        """Sets a shared value of the game, such as the time left. It is sent to all clients, also to later ones.

        The value is sent as it is now. If you change a list later, call `share` again.

        Args:
            name: name of the value, 1 to 32 characters.
            value: any MessagePack value of at most 256 bytes; None removes the value.

        Raises:
            SceneError: the game would have more than 32 shared values, or the value has more than 256 bytes.
        """
        self.turn.check("share")
        self.shared_values.set(name, value)

    def send(self, name: str, data: Any = None, to: Player | Iterable[Player] | None = None) -> None:
        """Sends a game event; the client gets it as `Happened`.

        Args:
            name: name of the event, 1 to 32 characters.
            data: any MessagePack value of at most 1,024 bytes.
            to: one player, several players, or None for all.

        Raises:
            SceneError: the name or the data are too long, the data are no MessagePack value, or `to` is wrong.
        """
        self.turn.check("send")
        self.outgoing.send(self.tick, name, data, to)

    def soon(self, act: Callable[..., object], *arguments: Any) -> None:
        """Calls a function within the next tick, before the other hooks.

        `soon` may be called at any time and from any thread or callback of asyncio; it is the way to change a game from
        there. The functions are called in the order of the calls. If one raises, the exception is logged and counted
        like that of a hook.

        Args:
            act: the function.
            arguments: its arguments.

        Raises:
            OutOfTurnError: 10,000 functions wait already; the game probably does not tick.
            RulesError: `act` is not a function, or is async.
        """
        self.hooks.soon(act, arguments)

    # -- called by the game ------------------------------------------------------------------------------------

    def _forget(self, entity: int) -> None:
        """Forgets the values that an entity has beside the world."""
        self._attributes.forget(entity)
        self._private.forget(entity)
        self.steered.pop(entity, None)

    def discard(self, entity: int) -> None:
        """Removes an existing entity, which may be a player's."""
        self._world.remove(entity)
        self._world.note([LEFT, entity])
        self._forget(entity)
        self.outcome.removed.append(entity)
