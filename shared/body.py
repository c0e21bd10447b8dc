"""The body: what a behaviour reads and changes of its entity in a turn.

All changes of a turn are made together at the end of the tick's turns (`shared.turns`), so every turn reads the other
entities as they were before. If a turn raises an exception, none of its changes is made.
"""

from typing import TYPE_CHECKING, Any

from shared import edits, layout
from shared.aim import AIM_MAX, NO_AIM
from shared.behaviours import Behaviour, BehaviourEntry
from shared.chance import drawn
from shared.changes import Changes
from shared.checks import SceneError, Vec, finite, shown, text, vector, whole
from shared.extras import RESERVED
from shared.free_places import OverlapError, box_at, free_place, taken
from shared.inputs import NEUTRAL, Input, make_input
from shared.layout import BUTTONS, FALLING, FLAGS, ID, MOVE_X, TEMPLATE, VX, X
from shared.messages import DONE
from shared.payloads import pack_value
from shared.seen import Seen
from shared.units import BLOCK, SPEED, to_position, to_velocity

if TYPE_CHECKING:
    from shared.world_turns import TurnWorld

NEAR_MAX = 64.0
"""Greatest distance of `Body.near`, in blocks."""
WAKE_MAX = (1 << 32) - 1
"""Greatest tick at which an entity can ask to have a turn."""


class Body:
    """The entity of a turn. Positions are in blocks, velocities in blocks/s, directions in -127..127.

    The fields of the behaviour are attributes of the body: `me.stamina -= 20`.

    Attributes:
        id: number of the entity.
        tick: number of the tick that is about to be computed.
    """

    __slots__ = (
        "_before", "_bits", "_drawn", "_extras", "_held", "_input", "_parts", "_state", "_values", "_world",
        "behaviour", "changes", "entry", "id", "tick",
    )  # fmt: skip
    behaviour: Behaviour
    entry: BehaviourEntry
    id: int
    tick: int

    def __init__(self, world: "TurnWorld") -> None:
        self._world, self._extras = world, world.extras
        self._state: list[int] = []
        self._before: list[int] = []
        self._values: list[int] = []
        self._input = NEUTRAL
        self._held = self._drawn = 0
        self._bits = world.scene.button_bits
        self.changes = False
        """Whether the turn has changed anything."""
        self._parts = Changes()

    if TYPE_CHECKING:  # a type checker knows no fields; at run time an unknown name is an error

        def __getattr__(self, name: str) -> Any: ...

        def __setattr__(self, name: str, value: Any) -> None: ...

    def begin(self, tick: int, state: list[int], values: list[int], input_: Input | None) -> None:
        """Begins the turn of another entity.

        Args:
            tick: the tick.
            state: its row in the world.
            values: its extra columns.
            input_: its input of this tick; None: it goes on with its latest one.
        """
        self.tick, self.id = tick, state[ID]
        self._state, self._before, self._values = state, values, values[:]
        self._held = state[BUTTONS]
        self._input = input_ if input_ is not None else self._held_input()
        self._drawn = 0
        if self.changes:
            self.changes = False
            self._parts = Changes()

    def taken(self) -> "Changes":
        """Returns the changes of the turn."""
        self._parts.values = self._values
        return self._parts

    # -- reading: the own entity ---------------------------------------------------------------------------

    @property
    def template(self) -> str:
        """The name of the entity's template."""
        return self._world.scene.templates[(self._parts.state or self._state)[TEMPLATE]].name

    @property
    def position(self) -> Vec:
        """The position of the entity."""
        x, y, z = self._state[X : X + 3]
        return x / BLOCK, y / BLOCK, z / BLOCK

    @property
    def velocity(self) -> Vec:
        """The velocity of the entity. Setting it takes effect in this tick's step.

        An entity that walks without `acceleration` sets the horizontal part from its input in every step.
        """
        x, y, z = (self._parts.state or self._state)[VX : VX + 3]
        return x / SPEED, y / SPEED, z / SPEED

    @velocity.setter
    def velocity(self, velocity: Vec) -> None:
        parts = zip("xyz", vector(velocity, "velocity"), strict=True)
        speed = [to_velocity(part, f"velocity.{axis}") for axis, part in parts]
        state = self._changed()
        state[VX : VX + 3] = speed
        state[FLAGS] |= self._world.thrown(state[TEMPLATE], speed[2])

    @property
    def falling(self) -> bool:
        """Whether gravity acts on the entity: nothing supported it at the end of the tick before."""
        return bool(self._state[FLAGS] & FALLING)

    # -- reading: the input --------------------------------------------------------------------------------

    @property
    def move(self) -> tuple[int, int]:
        """The direction of this tick's input: east and north, each -127 to 127."""
        x, y = self._input[:2]
        return _limited(x), _limited(y)

    def held(self, button: str) -> bool:
        """Returns whether a button is held in this tick's input."""
        return self._input[2] & self._bit(button) != 0

    def pressed(self, button: str) -> bool:
        """Returns whether a button is held in this tick's input, and was not in the one before."""
        return self._input[2] & ~self._held & self._bit(button) != 0

    def released(self, button: str) -> bool:
        """Returns whether a button was held in the input of the tick before, and is not in this one."""
        return ~self._input[2] & self._held & self._bit(button) != 0

    @property
    def aim(self) -> Vec | None:
        """The direction in which the player aims, of length 1; None: the player does not aim."""
        aim = self.aim_steps
        return None if aim == NO_AIM else (aim[0] / AIM_MAX, aim[1] / AIM_MAX, aim[2] / AIM_MAX)

    @property
    def aim_steps(self) -> tuple[int, int, int]:
        """The direction in which the player aims, as whole numbers of length 32,767; (0, 0, 0): none.

        Raises:
            SceneError: the scene has no aim.
        """
        if not self._extras.aims:
            raise SceneError("aim: the scene has no aim (`Scene.aim`)")
        return self._input.aim

    def steer(self, x: float, y: float, *, jump: bool = False, buttons: int = 0) -> None:
        """Replaces the input of this tick, for example of an entity that is stunned or slowed. Arguments as for
        `make_input`.

        In the next tick, `pressed` and `released` compare with the replaced input.
        """
        made = make_input(x, y, jump=jump, buttons=buttons)
        self.changes = True
        self._parts.steered = self._input._replace(move_x=made.move_x, move_y=made.move_y, buttons=made.buttons)

    # -- reading: the world --------------------------------------------------------------------------------

    def block(self, x: int, y: int, z: int) -> int | None:
        """Returns the kind of a block, 0 for air; None if its segment is not loaded."""
        return self._world.block(x, y, z)

    def kind(self, name: str) -> int:
        """Returns the number of a named kind of blocks of the scene, for `block` and `edit`.

        Raises:
            SceneError: there is no such kind.
        """
        return self._world.scene.kind(name)

    def near(self, distance: float, template: str | None = None) -> list[Seen]:
        """Returns the other entities around this one, ascending by number.

        Args:
            distance: greatest distance of their boxes from this entity's position along each axis, 0 to 64 blocks.
            template: name of the template to look for; None: all.
        """
        if not 0 <= finite(distance, "distance") <= NEAR_MAX:
            raise SceneError(f"distance = {distance!r}: must be 0 to {NEAR_MAX:g}")
        reach = to_position(distance, "distance")
        place = self._state[X : X + 3]
        return self._found([part - reach for part in place] + [part + reach for part in place], template)

    def touching(self, template: str | None = None) -> list[Seen]:
        """Returns the other entities whose boxes share at least a point with this entity's box, ascending by number.

        Args:
            template: name of the template to look for; None: all.
        """
        return self._found(box_at(self._world, self._state[TEMPLATE], self._state[X : X + 3]), template)

    def owns(self, entity: int) -> bool:
        """Returns whether this entity has spawned another one: its number is one of those that belong to this one."""
        extras = self._extras
        reserved = self._before[extras.alive] & RESERVED
        return self.id < entity <= self.id + (extras.spawns if reserved else 0)

    def chance(self, n: int) -> int:
        """Returns a whole number from 0 to n - 1 that depends on the scene's `chance`, the tick, the entity and the
        number of calls in this turn. Clients can compute it ahead of time."""
        whole(n, "n", 1, 1 << 32)
        self._drawn += 1
        return drawn(n, self._world.scene.chance, self.tick, self.id, self._drawn)

    # -- changing ------------------------------------------------------------------------------------------

    def become(self, template: str) -> bool:
        """Changes the template of the entity. Returns whether there is room for the new box; if not, nothing changes.

        Raises:
            SceneError: there is no such template.
        """
        kind = self._world.scene.template(template)
        state = self._parts.state or self._state
        if kind == state[TEMPLATE]:
            return True
        if taken(self._world, self._row, kind, box_at(self._world, kind, state[X : X + 3])):
            return False
        before, extras = state[TEMPLATE], self._extras
        self._changed()[TEMPLATE] = kind
        if extras.behaviour_of[before] != extras.behaviour_of[kind]:
            self._values[extras.first :] = extras.starts[kind, extras.first :].tolist()
            self._values[extras.wakes_at] = int(extras.new[kind, extras.wakes_at])
        return True

    def edit(self, x: int, y: int, z: int, kind: int) -> bool:
        """Places (kind 1 to 255) or removes (0) a block within `Scene.reach`. Returns whether that is possible."""
        edit = edits.checked(x, y, z, kind)
        if edits.verdict(self._world, self.id, edit) != DONE:
            return False
        self._parts.edits.append(edit)
        self._acted()
        return True

    def spawn(self, template: str, position: Vec, velocity: Vec = (0.0, 0.0, 0.0), **fields: int) -> int | None:
        """Adds an entity that belongs to this one, under a number that server and client compute alike.

        Args:
            template: name of its template.
            position: in blocks, rounded to the grid.
            velocity: in blocks/s.
            fields: start values of the fields of its behaviour, by name.

        Returns:
            Its number; None if the place is occupied, or `Behaviour.spawns` entities exist already.

        Raises:
            SceneError: a value is not valid, or the behaviour has no `spawns`.
        """
        world, extras = self._world, self._extras
        kind = world.scene.template(template)
        slots, alive, acts = extras.spawns, self._values[extras.alive], self._values[extras.acts]
        if not self.entry.spawns:
            raise SceneError(f"spawn: {self.entry.name}.spawns is 0; set it to the number of entities at a time")
        if not alive & RESERVED:
            raise SceneError(
                "spawn: no numbers are reserved for this entity: it began with a template whose behaviour has no "
                "`spawns`, or another entity has spawned it"
            )
        speed = [to_velocity(v, f"velocity.{a}") for a, v in zip("xyz", vector(velocity, "velocity"), strict=True)]
        values = extras.new[kind].tolist()
        values[extras.alive] = 0  # the numbers after its own belong to this entity
        for name, value in fields.items():
            k, declared = world.field_column(kind, name)
            values[k] = declared.checked(value)
        if (alive & ~RESERVED).bit_count() >= self.entry.spawns:
            return None
        slot = next(k % slots for k in range(acts, acts + slots) if not alive >> k % slots & 1)
        try:
            at = free_place(world, -1, kind, position, False)
        except OverlapError:
            return None
        entity = self.id + 1 + slot
        self.set_column(extras.alive, alive | 1 << slot)
        self._acted()
        self._parts.spawned.append([entity, kind, world.thrown(kind, speed[2]), *at, *speed, 0, 0, 0, *values])
        return entity

    def remove(self, entity: int | None = None) -> None:
        """Removes this entity, or one that it has spawned (`owns`), after all turns of the tick.

        Raises:
            SceneError: the other entity does not belong to this one, or does not exist; or this one is a player's.
        """
        self.changes = True
        if entity is None or entity == self.id:
            if self._world.scene.player in self.entry.templates:
                raise SceneError(f"remove: entity {self.id} is a player's; only the game's rules can end a player")
            self._parts.removed.append(self.id)
        elif self.owns(entity) and entity in self._world:
            self._parts.removed.append(entity)
        else:
            raise SceneError(f"entity = {shown(entity)}: is not one that entity {self.id} has spawned")

    def wake(self, tick: int) -> None:
        """Asks for a turn at a later tick, even if the entity stands still without an input then; 0: takes it back.

        Only the latest call counts.
        """
        self.set_column(self._extras.wakes_at, whole(tick, "tick", 0, WAKE_MAX))

    def announce(self, name: str, data: Any = None) -> None:
        """Sends a game event to all players who see the entity.

        The player of the entity gets it in the frame that predicts it (`Announced`); the client takes it back with
        `Withdrawn` if the server's tick turns out differently.

        Args:
            name: name of the event, 1 to 32 characters.
            data: any MessagePack value of at most 1,024 bytes.

        Raises:
            SceneError: the name is not valid.
            ValueError: the data is not valid.
        """
        self._parts.announced.append((text(name, "name", 32), pack_value(data)))
        self._acted()

    # -- inside --------------------------------------------------------------------------------------------

    @property
    def _row(self) -> int:
        return self._world.row_of(self.id)

    def _held_input(self) -> Input:
        """Returns the latest input of the entity, with which it goes on."""
        x, y, buttons = self._state[MOVE_X : BUTTONS + 1]
        return Input(
            x, y, buttons, (self._values[0], self._values[1], self._values[2]) if self._extras.aims else NO_AIM
        )

    def _changed(self) -> list[int]:
        """Returns the state to change."""
        self.changes = True
        if self._parts.state is None:
            self._parts.state = self._state[: layout.CELL]
        return self._parts.state

    def set_column(self, column: int, value: int) -> None:
        """Sets an extra column."""
        self.changes = True
        self._values[column] = value
        self._parts.mask |= 1 << column

    def _acted(self) -> None:
        acts = self._extras.acts
        self.set_column(acts, (self._values[acts] + 1) & 0xFFFF)

    def _bit(self, button: str) -> int:
        return self._bits.get(button) or self._world.scene.button(button)

    def _found(self, box: list[int], template: str | None) -> list[Seen]:
        world = self._world
        kind = None if template is None else world.scene.template(template)
        return [world.seen(row) for row in world.rows_in(box, self._row, kind)]


def _limited(part: int) -> int:
    """Returns a part of a direction within -127..127, as the kernel limits it."""
    return min(max(part, -127), 127)
