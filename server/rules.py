"""The rules of a game: a class with hooks that the server calls, loaded by its name.

    class Tag(Rules):
        def on_join(self, player: Player) -> None:
            self.game.set(player.entity, "it", False)

    sovereign-server --game my_game:Tag

The server calls all hooks within a tick, before the step, in this order: `on_start`, the functions given to
`game.soon`, `on_leave`, `can_join` and `on_join`, `on_fell_out`, `on_command` and `can_edit`, `on_contact_end`,
`on_contact`, `on_block_contact`, `on_exit`, `on_enter`, `on_tick`; at the end `on_stop`. If a hook raises, the
exception is logged and counted, and the game goes on. A hook is a plain function and must not wait. Code that waits
runs in a task or a thread of its own and hands its result back with `game.soon`.

Hooks read and change the game through `self.game`, a `server.game_api.api.GameApi`. Decisions about the world must use
nothing else: `self.game.random` gives the same numbers when a game is computed again, but a clock or the order of a set
does not.
"""

import importlib
import inspect
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from server.config.options import nearest
from server.declared import Value, check_declaration, check_options, option
from server.functions import RulesError as RulesError
from server.functions import checked_function as checked_function
from server.functions import checked_result as checked_result
from server.players.player import Player
from server.players.ticket import Ticket as Ticket
from shared.behaviours import Behaviour, checked_classes
from shared.checks import SceneError, shown
from shared.scene import Scene

if TYPE_CHECKING:
    from server.game_api.api import GameApi


class Rules:
    """The base class of a game's rules.

    As it is, players walk, jump, place and remove blocks. A subclass overrides the hooks that it needs.
    """

    scene = ""
    """The scene to play if the operator names none: a name or the path of a file. Empty: the server's default."""

    names = "any"
    """Rule for the names of players. "any": as the client gives it. "clean": without hidden characters and double
    spaces, and never empty. "unique": clean, and with a number behind it if another player has the name."""

    behaviours: Sequence[type[Behaviour]] = ()
    """The behaviours of the game (`shared.behaviours`). Clients pass the same classes to `Client.connect`."""

    commands: Mapping[str, Mapping[str, Value]] = {}
    """Declared commands (`server.declared`), whose fields are checked before `on_command`. Empty: any command."""

    options: Mapping[str, Value] = {}
    """Options of the game, which the operator sets by `--option name=value`: fields with defaults (`server.declared`).
    The value of each is an attribute of the rules with its name."""

    events: Mapping[str, str] = {}
    """Meanings of the game's events by name, for `sovereign-server describe`."""

    attributes: Mapping[str, str] = {}
    """Meanings of the attributes of entities by name, for `sovereign-server describe`."""

    keys: Mapping[str, str] = {}
    """Keys of the window of `sovereign-play`, by button: names as pygame has them, like "left shift", or "left mouse",
    "right mouse". A button without one gets one of the window's own choice."""

    game: "GameApi"
    """The game API of the running game. Not available in `__init__` and `prepare`."""

    if not TYPE_CHECKING:  # with a visible __getattr__ a type checker would accept every misspelt attribute

        def __getattr__(self, name: str) -> Any:
            if name == "game":
                raise AttributeError("self.game is not available in __init__ and prepare, only from on_start on")
            if name in type(self).options:
                return type(self).options[name].default
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)

    def prepare(self, scene: Scene) -> Scene:
        """Returns the scene to play. Called once, before the world is made; add templates here.

        Args:
            scene: the scene that the operator or `Rules.scene` names; `Scene.with_template` adds a template to it.
        """
        return scene

    def bot_policy(self, random: Any) -> Any:
        """Returns the policy of a bot of this game (`client_sdk.bots.Policy`); None: it wanders.

        Args:
            random: the source of all chance of the bot.
        """
        return None

    async def load_player(self, name: str, subject: str) -> Any:
        """Fetches what the game knows of a player, for example from a database, before a new player joins.

        This is the one method that may wait: the client waits with it, the ticks go on. It must not use `self.game`.
        Not called when a player reconnects.

        Args:
            name: the name that the client gave.
            subject: the subject of the client's token; empty if the server does not ask for tokens.

        Returns:
            Anything; `on_join` finds it in `player.loaded`.

        Raises:
            ValueError: the player may not join; the client gets the text as the reason.
        """
        return None

    @staticmethod
    def pair(waiting: list[Ticket]) -> Iterable[Sequence[Ticket]]:
        """Returns groups of the clients that wait for a match, each of which gets a new world (`docs/worlds.md`).

        Called about once per second while clients wait. Without a `pair` of its own, a kind of worlds lets each client
        join the fullest world with room for it, or makes one.

        Args:
            waiting: the tickets, in the order in which they came: `name`, `subject`, `properties`, `seats`, `waited_s`,
                and `loaded`, the result of `load_player`. Tickets in no group go on waiting.
        """
        return ()

    def on_start(self) -> None:
        """Called once, when the world exists and no player has joined. Not called when a saved game is restored."""

    def on_stop(self) -> None:
        """Called once when the server stops in order, ahead of the last save; not after a crash.

        Changes are saved, but clients no longer get them.
        """

    def on_join(self, player: Player) -> None:
        """Called when a new player has an entity. Not called when a player reconnects."""

    def on_leave(self, player: Player) -> None:
        """Called when a player leaves for good, before the entity is removed."""

    def on_tick(self) -> None:
        """Called once per tick, after the other hooks and before the step.

        `game.held`, `pressed`, `released`, `move` and `aim` give the inputs that the step of this tick uses.
        """

    def on_command(self, player: Player, name: str, payload: Any) -> bool | str | None:
        """Called for each command that a client sends with `Client.command`, except for edits of blocks.

        Args:
            player: the sender.
            name: name of the command, chosen by the game.
            payload: data of the command: any MessagePack value. A client can send anything, so check it, or declare
                the commands (`Rules.commands`): then it is a table of checked values.

        Returns:
            False if the command is not allowed, or a text that says why: the client gets that as the result, with at
            most 500 characters. True or None if it was done.
        """
        return False

    def on_contact(self, a: int, b: int) -> None:
        """Called when two entities (a < b) have begun to touch: in the latest step, or when the rules placed one.

        Called again for entities that still touch if the template of one has changed since, except by this call.
        """

    def on_contact_end(self, a: int, b: int) -> None:
        """Called when two entities (a < b) have ceased to touch. One of them may no longer exist."""

    def on_block_contact(self, entity: int, x: int, y: int, z: int) -> None:
        """Called when a side of an entity has begun to touch solid blocks: it landed, or ran or flew against them.

        Args:
            entity: the entity. A side that goes on touching blocks is not reported again, whichever blocks these are.
            x, y, z: the block that is nearest to the middle of the side.
        """

    def on_enter(self, zone: str, entity: int) -> None:
        """Called when an entity has entered a zone (`game.add_zone`): their boxes overlap."""

    def on_exit(self, zone: str, entity: int) -> None:
        """Called when an entity has left a zone. It may no longer exist."""

    def on_fell_out(self, entity: int) -> bool | None:
        """Called when an entity is below the floor of the world.

        Returns:
            True if the rules have dealt with it. Otherwise the server puts the entity at a spawn point.
        """
        return False

    def can_join(self, name: str, subject: str) -> bool | str:
        """Returns whether a new player may join. A text refuses it; the client gets that reason with `Left`.

        Not called when a player reconnects.

        Args:
            name: the name that the player would have.
            subject: the subject of the client's token; empty if the server does not ask for tokens.
        """
        return True

    def can_edit(self, player: Player, x: int, y: int, z: int, kind: int) -> bool | str:
        """Returns whether a player may place (kind 1 to 255) or remove (kind 0) the block at (x, y, z).

        A text refuses it, with that reason in the result that the client gets.
        The server checks reach and overlap with entities besides.
        """
        return True


def load_rules(name: str, options: Mapping[str, object] | None = None) -> Rules:
    """Loads the class `module:Class` and returns an instance. The working directory is searched for modules, too.

    Args:
        name: the class.
        options: values of the game's options by name, which become attributes ahead of `__init__`. A text is converted
            to the type of the option. None: the defaults.

    Raises:
        RulesError: there is no such class, it cannot be instantiated, or it cannot be used as rules.
    """
    module_name, colon, class_name = name.partition(":")
    if not colon or not module_name or not class_name:
        raise RulesError(f"game = {name!r}: must be module:Class, like my_game:Tag")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        made: Any = getattr(importlib.import_module(module_name), class_name)
        rules: Rules = with_options(made, options) if options else made()
    except RulesError as error:
        raise RulesError(f"game = {name!r}: {error}") from error
    except Exception as error:
        raise RulesError(f"game = {name!r}: cannot be loaded ({type(error).__name__}: {error})") from error
    try:
        check_rules(rules)
    except RulesError as error:
        raise RulesError(f"game = {name!r}: {error}") from error
    return rules


def with_options(rules: Any, options: Mapping[str, object]) -> Rules:
    """Returns a new instance of a class of rules with values for its options.

    Raises:
        RulesError: the rules have no such option, or its value does not match the declaration.
    """
    if not isinstance(rules, type) or not issubclass(rules, Rules):
        raise RulesError(f"{shown(rules)}: is no subclass of server.rules.Rules, and has no options")
    _checked_options(rules)
    made: Any = rules.__new__(rules)
    for name, given in options.items():
        if name not in rules.options:
            there = nearest(name, rules.options) or f" (there are {', '.join(rules.options) or 'none'})"
            raise RulesError(f"option {name} = {shown(given)}: no such option{there}")
        try:
            setattr(made, name, option(rules.options[name], given))
        except ValueError as error:
            raise RulesError(f"option {name} = {shown(given)}: {error}") from None
    made.__init__()
    return made  # type: ignore[no-any-return]


def _checked_options(rules: type[Rules]) -> None:
    """Checks the declared options of rules.

    Raises:
        RulesError: they cannot be used.
    """
    try:
        check_options(rules.options, rules)
    except SceneError as error:
        raise RulesError(str(error)) from None


METHODS_MAX = 1024
"""Maximum number of methods of which it is noted that they can be called as hooks. The check takes 0.1 ms each."""
_good_methods: set[tuple[object, str]] = set()


def check_rules(rules: object) -> None:
    """Checks rules before any of their hooks is called, to report mistakes that would have no effect otherwise.

    Raises:
        RulesError: `rules` is not an instance of a subclass of `Rules`, a method has a name that looks like a hook's
            and is none, or a hook cannot be called, or not with the arguments that it gets.
    """
    if isinstance(rules, type) and issubclass(rules, Rules):
        raise RulesError(f"rules = {rules.__qualname__}: is a class; pass an instance, {rules.__name__}()")
    if not isinstance(rules, Rules):
        raise RulesError(f"rules = {shown(rules)}: must be an instance of a subclass of server.rules.Rules")
    owner = type(rules).__qualname__
    if not isinstance(rules.scene, str):
        raise RulesError(f"{owner}.scene = {shown(rules.scene)}: must be the name of a scene, or the path of its file")
    if rules.names not in NAMES:
        raise RulesError(f"{owner}.names = {shown(rules.names)}: must be one of {', '.join(NAMES)}")
    try:
        check_declaration(rules.commands, f"{owner}.commands")
    except SceneError as error:
        raise RulesError(str(error)) from None
    _checked_options(type(rules))
    plain = {hook.replace("_", ""): hook for hook in HOOKS}
    for name in dir(rules):
        meant = plain.get(name.lower().replace("_", ""), "")
        looks = name.startswith(("on_", "can_")) or (meant and not name.startswith("_"))
        if looks and name not in HOOKS:
            there = f" (did you mean {meant}?)" if meant else nearest(name, HOOKS)
            raise RulesError(
                f"{owner}.{name} is no hook, and nothing calls it{there}; the hooks are {', '.join(HOOKS)}"
            )
    if not inspect.iscoroutinefunction(rules.load_player):
        raise RulesError(f"{owner}.load_player: must be async (`async def`), because it may wait")
    for name in HOOKS:
        hook = getattr(rules, name)
        method = (getattr(hook, "__func__", None), name)
        if method not in _good_methods:
            checked_function(hook, f"{owner}.{name}")
            _check_parameters(hook, name, owner)
            if method[0] is not None and len(_good_methods) < METHODS_MAX:
                _good_methods.add(method)


def _check_parameters(hook: Callable[..., object], name: str, owner: str) -> None:
    """Checks that a hook can be called with the arguments that it gets, by position.

    Raises:
        RulesError: it cannot; every call of it would fail.
    """
    wanted = [*inspect.signature(getattr(Rules, name)).parameters][1:]
    takes = "(...)"
    try:
        signature = inspect.signature(hook)
        takes = f"({', '.join(map(str, signature.parameters))})"
        signature.bind(*wanted)
    except (TypeError, ValueError) as error:
        if isinstance(error, ValueError) and not inspect.ismethod(hook):
            return  # a function in C that does not tell its parameters
        raise RulesError(f"{owner}.{name}{takes}: is called with ({', '.join(wanted)}): {error}") from None


def overrides(rules: Rules, name: str) -> bool:
    """Returns whether the class of rules has a hook of its own."""
    return getattr(type(rules), name) is not getattr(Rules, name)


def prepared(rules: Rules, scene: Scene) -> Scene:
    """Returns the scene to play: the result of `Rules.prepare` for `scene`, with the rules' behaviours.

    Raises:
        RulesError: `rules` cannot be used (see `check_rules`), `prepare` fails, or its result is not a scene.
        SceneError: `prepare` makes an invalid scene.
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
    return equipped(made, rules)


def equipped(scene: Scene, rules: Rules) -> Scene:
    """Returns a scene with the behaviours of rules, as far as it does not have them.

    Raises:
        RulesError: a behaviour is not valid.
    """
    there = {entry.code for entry in scene.behaviours}
    try:
        return scene.with_behaviours([each for each in checked_classes(rules.behaviours) if each not in there])
    except SceneError as error:
        raise RulesError(f"{type(rules).__qualname__}.{error}") from error


NAMES = ("any", "clean", "unique")
"""Choices of `Rules.names`."""
HOOKS = ("prepare", *(name for name in vars(Rules) if name.startswith(("on_", "can_"))))
"""Names of the methods of rules that the server calls."""
