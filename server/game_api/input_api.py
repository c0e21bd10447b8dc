"""The part of the game API that reads and sets inputs: buttons, directions and aims of entities.

Within a tick, the hooks get the input that the step of this tick uses for an entity. A player's input is chosen from
its queue (`InputQueue.coming`), so a substitute for a missing input counts like an input. The input of the tick before
is in the entity's state.
"""

from collections.abc import Sequence

from server.game_api.turn import Turn
from server.journal.recorded_world import RecordedWorld
from server.players.player import Player
from shared.aim import NO_AIM, direction
from shared.buttons import Names
from shared.checks import SceneError, Vec, shown, whole
from shared.fields import ENTITY_MAX
from shared.inputs import MOVE_MAX, Input, make_input
from shared.layout import BUTTONS, MOVE_X, MOVE_Y
from shared.states import STATES
from shared.world import World


class InputApi:
    """The inputs of a game's entities, for its rules.

    Args:
        world: the world of the game.
        players: players by entity.
        turn: the right to change the game.
    """

    def __init__(self, world: RecordedWorld, players: dict[int, Player], turn: Turn) -> None:
        self.turn = turn
        self.steered: dict[int, Input] = {}
        self._world, self._players = world, players

    def held(self, who: Player | int, button: str) -> bool:
        """Returns whether a button is held in the tick that is about to be computed.

        Args:
            who: a player, or the number of an entity.
            button: name of the button, one of `scene.buttons`.

        Raises:
            SceneError: the scene has no such button.
        """
        bit = self._world.scene.button(button)
        return self._input(self._whose(who)).buttons & bit != 0

    def pressed(self, who: Player | int, button: str) -> bool:
        """Returns whether a button goes down in this tick: it is held now, and was not in the tick before.

        The arguments are those of `held`.
        """
        bit, entity = self._world.scene.button(button), self._whose(who)
        return self._input(entity).buttons & ~self._world.state(entity)[BUTTONS] & bit != 0

    def released(self, who: Player | int, button: str) -> bool:
        """Returns whether a button goes up in this tick: it was held in the tick before, and is not now.

        The arguments are those of `held`.
        """
        bit, entity = self._world.scene.button(button), self._whose(who)
        return self._world.state(entity)[BUTTONS] & ~self._input(entity).buttons & bit != 0

    def move(self, who: Player | int) -> tuple[float, float]:
        """Returns the direction (east, north) of the input of this tick; its length is the share of full speed.

        Args:
            who: a player, or the number of an entity.
        """
        x, y, _, _ = self._input(self._whose(who))
        return x / MOVE_MAX, y / MOVE_MAX

    def aim(self, who: Player | int) -> Vec | None:
        """Returns the aim of the input of this tick, a direction (x, y, z) of length 1; None if it aims nowhere.

        Args:
            who: a player, or the number of an entity.

        Raises:
            SceneError: the scene has no aim.
        """
        if not self._world.scene.aim:
            raise SceneError(f"aim: the scene {self._world.scene.name!r} has no aim (`Scene.aim`)")
        return direction(self._input(self._whose(who)).aim)

    def steer(
        self,
        entity: int,
        x: float,
        y: float,
        *,
        jump: bool = False,
        buttons: Names = (),
        aim: Sequence[float] | None = None,
    ) -> None:
        """Sets the input of an entity that is not a player's. It holds until the next call.

        Args:
            entity: number of the entity.
            x: direction to the east, from -1 to 1.
            y: direction to the north, from -1 to 1.
            jump: whether to jump.
            buttons: the buttons that are held: names, or a table of names and truth values.
            aim: direction (x, y, z) in space, of any length; None: no aim.

        Raises:
            SceneError: the entity is a player's, or the scene has no such button or no aim.
        """
        self.turn.check("steer")
        entity = self._known(entity)
        if entity in self._players:
            raise SceneError(f"entity = {entity}: is a player's, whose client chooses its inputs")
        scene = self._world.scene
        input_ = make_input(x, y, jump=jump, buttons=scene.buttons_bits(buttons), aim=aim)
        scene.check_aim(input_.aim)
        self.steered[entity] = input_

    # -- inside ------------------------------------------------------------------------------------------------

    def _input(self, entity: int) -> Input:
        """Returns the input of an existing entity for the tick that is about to be computed."""
        player = self._players.get(entity)
        if player is not None:
            return player.coming(self._world.tick + 1)
        if entity in self.steered:
            return self.steered[entity]
        return held_input(self._world, entity)

    def _whose(self, who: Player | int) -> int:
        """Returns the number of an existing entity, for a player or a number."""
        return self._known(who.entity if isinstance(who, Player) else who)

    def _number(self, entity: object) -> int:
        """Checks the number of an entity, which need not exist, and returns it as an int of Python.

        Raises:
            SceneError: it is not a whole number, or out of range.
        """
        if isinstance(entity, Player):
            raise SceneError(f"entity = {shown(entity)}: is a player; its entity is `player.entity`")
        return whole(entity, "entity", 1, ENTITY_MAX)

    def _known(self, entity: object) -> int:
        """Checks the number of an existing entity and returns it as an int of Python.

        Raises:
            MissingError: there is no such entity.
            SceneError: it is not a whole number, or out of range.
        """
        number = self._number(entity)
        self._world.awake(number)  # raises MissingError if there is no such entity
        return number


def held_input(world: World, entity: int) -> Input:
    """Returns the input that an entity had in the latest step."""
    state = world.state(entity)
    aim = (state[STATES], state[STATES + 1], state[STATES + 2]) if world.scene.aim else NO_AIM
    return Input(state[MOVE_X], state[MOVE_Y], state[BUTTONS], aim)
