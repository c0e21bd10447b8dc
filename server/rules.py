"""A game on top of moving and editing: a class with hooks, loaded by name.

    class Tag(Rules):
        def on_join(self, player: Player) -> None:
            self.game.set(player.entity, "it", False)

    sovereign-server --game my_game:Tag

All hooks are called within a tick, ahead of its step, in this order: `on_start`, `on_leave`, `on_join`, `on_fell_out`,
`on_command` and `can_edit`, `on_contact`, `on_tick`. One that raises is reported and counted, and the game goes on.
What they may do is `self.game`, a `server.stage.Stage`. Whatever decides what happens in the world must come from
there: its `random` is the same again in a game that is computed anew; a clock's time or the order of a set is not.
"""

import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from server.session import Player
from shared.scene import Scene

if TYPE_CHECKING:
    from server.stage import Stage


class RulesError(ValueError):
    """Rules that cannot be used; the message says why."""


class Rules:
    """No rules: players walk, jump, place and remove blocks. Override what is to be different."""

    scene = ""
    """The scene to be played in where the operator names none; empty: the server's default."""

    game: "Stage"
    """The running game; not yet there in `__init__` and `prepare`."""

    def prepare(self, scene: Scene) -> Scene:
        """The scene to play in, before anything begins: the place to add templates (`Scene.with_template`)."""
        return scene

    def on_start(self) -> None:
        """The world is there, nobody has joined. Not called when a stored game goes on."""

    def on_join(self, player: Player) -> None:
        """A player has got an entity. Who comes back after a lost connection has never left."""

    def on_leave(self, player: Player) -> None:
        """A player leaves, and the entity will be removed."""

    def on_tick(self) -> None:
        """Once a tick, before anything moves."""

    def on_command(self, player: Player, name: str, payload: Any) -> bool | None:
        """A client's command (`Client.command`); False: it is answered with "not allowed"."""
        return False

    def on_contact(self, a: int, b: int) -> None:
        """Two entities (a < b) have begun to touch in the latest step, or were put so."""

    def on_fell_out(self, entity: int) -> bool | None:
        """An entity is below the floor of the world; True: it has been seen to. Else it comes back at a spawn."""
        return False

    def can_edit(self, player: Player, x: int, y: int, z: int, kind: int) -> bool:
        """Whether a player may place (kind 1 to 255) or remove (0) that block; reach and overlap are checked anyway."""
        return True


def load_rules(name: str) -> Rules:
    """The rules `module:Class`; a module beside the working directory is found, too.

    Raises:
        RulesError: there is no such class, or it cannot be made.
    """
    module_name, colon, class_name = name.partition(":")
    if not colon or not module_name or not class_name:
        raise RulesError(f"game = {name!r}: must be module:Class, like my_game:Tag")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module_name), class_name)
        rules = found()
    except Exception as error:
        raise RulesError(f"game = {name!r}: cannot be loaded ({type(error).__name__}: {error})") from error
    if not isinstance(rules, Rules):
        raise RulesError(f"game = {name!r}: is no subclass of server.rules.Rules")
    hooks = [hook for hook in dir(Rules) if hook.startswith(("on_", "can_"))]
    for hook in dir(rules):
        if hook.startswith(("on_", "can_")) and hook not in hooks:
            raise RulesError(f"game = {name!r}: {hook} is no hook, and nothing calls it (there are {', '.join(hooks)})")
    return rules
