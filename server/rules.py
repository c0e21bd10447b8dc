"""A game on top of moving and editing: a class with hooks, loaded by name.

    class Tag(Rules):
        def on_join(self, player: Player) -> None:
            self.game.set(player.entity, "it", False)

    sovereign-server --game my_game:Tag

All hooks are called within a tick, ahead of its step, in this order: `on_start`, the functions given to `game.soon`,
`on_leave`, `on_join`, `on_fell_out`, `on_command` and `can_edit`, `on_contact`, `on_tick`. One that raises is reported
and counted, and the game goes on. A hook is a plain function: whatever waits for something runs elsewhere, in a task or
a thread, and comes back by `game.soon`.

What they may do is `self.game`, a `server.stage.Stage`. Whatever decides what happens in the world must come from
there: its `random` is the same again in a game that is computed anew; a clock's time or the order of a set is not.
"""

import importlib
import inspect
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from server.kinds import nearest
from server.session import Player
from shared.checks import SceneError, shown
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

    if not TYPE_CHECKING:  # so that a type checker goes on to find names that are not there

        def __getattr__(self, name: str) -> Any:
            if name == "game":
                raise AttributeError("self.game is not there yet in __init__ and prepare; from on_start on it is")
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)

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
        rules: Rules = getattr(importlib.import_module(module_name), class_name)()
    except Exception as error:
        raise RulesError(f"game = {name!r}: cannot be loaded ({type(error).__name__}: {error})") from error
    try:
        check_rules(rules)
    except RulesError as error:
        raise RulesError(f"game = {name!r}: {error}") from error
    return rules


def check_rules(rules: object) -> None:
    """Checks rules before anything of them is called: a mistake that would be silent is named.

    Raises:
        RulesError: they are no rules; a method is named like a hook that there is not; or a hook cannot be called.
    """
    if isinstance(rules, type) and issubclass(rules, Rules):
        raise RulesError(f"rules = {rules.__qualname__}: is a class; give an instance of it, {rules.__name__}()")
    if not isinstance(rules, Rules):
        raise RulesError(f"rules = {shown(rules)}: is no subclass of server.rules.Rules")
    owner = type(rules).__qualname__
    if not isinstance(rules.scene, str):
        raise RulesError(f"{owner}.scene = {shown(rules.scene)}: must be the name of a scene, or the path of its file")
    plain = {hook.replace("_", ""): hook for hook in HOOKS}
    for name in dir(rules):
        meant = plain.get(name.lower().replace("_", ""), "")
        looks = name.startswith(("on_", "can_")) or (meant and not name.startswith("_"))
        if looks and name not in HOOKS:
            there = f" (did you mean {meant}?)" if meant else nearest(name, HOOKS)
            raise RulesError(f"{owner}.{name} is no hook, and nothing calls it{there}; there are {', '.join(HOOKS)}")
    for name in HOOKS:
        checked_function(getattr(rules, name), f"{owner}.{name}")


def checked_function(act: object, at: str) -> None:
    """Checks what is to be called within a tick.

    Raises:
        RulesError: it cannot be called, or a call of it would do nothing: it is async, or a generator.
    """
    if not callable(act):
        raise RulesError(f"{at} = {shown(act)}: must be a function")
    if any(test(part) for test in ASYNC for part in (act, type(act).__call__)):
        raise RulesError(f"{at}: must not be async: it is called within a tick, which waits for nothing")
    if inspect.isgeneratorfunction(act):
        raise RulesError(f"{at}: must not contain `yield`: a call of it would do nothing")


def checked_result(result: Any, name: str) -> Any:
    """Returns what a hook has returned.

    Raises:
        RulesError: it is something that still has to be run: the hook is async behind a decorator, for example.
    """
    if result is None or result is True or result is False:
        return result
    if inspect.isawaitable(result) or inspect.isgenerator(result) or inspect.isasyncgen(result):
        if inspect.iscoroutine(result):
            result.close()  # else Python warns of it as well
        raise RulesError(f"{name} returned {type(result).__name__}, which nothing runs: it must be a plain function")
    return result


def prepared(rules: Rules, scene: Scene) -> Scene:
    """The scene that rules want to be played in.

    Raises:
        RulesError: they are no rules, `prepare` fails, or it does not return a scene.
        SceneError: it makes a scene that cannot be.
    """
    check_rules(rules)
    name = f"{type(rules).__qualname__}.prepare"
    try:
        made: object = checked_result(rules.prepare(scene), name)
    except (SceneError, RulesError):
        raise
    except Exception as error:
        raise RulesError(f"{name} failed ({type(error).__name__}: {error})") from error
    if not isinstance(made, Scene):
        raise RulesError(f"{name} returned {shown(made)}: it must return the scene to play in")
    return made


ASYNC = (inspect.iscoroutinefunction, inspect.isasyncgenfunction)
"""What tells that a function is async."""
HOOKS = ("prepare", *(name for name in vars(Rules) if name.startswith(("on_", "can_"))))
"""The methods of rules that are called."""
