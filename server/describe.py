"""The command `sovereign-server describe`: prints what a game consists of, for its developers and those of clients."""

from collections.abc import Iterator, Sequence

from server.config.options import Parser
from server.declared import REQUIRED, Value
from server.rules import HOOKS, Rules, load_rules, overrides, prepared
from shared.behaviours import BehaviourEntry
from shared.scene import Scene, load_scene

WIDTH = 12
"""Width of the column of names, in characters."""


def main(arguments: Sequence[str]) -> int:
    """Runs `sovereign-server describe`. Returns the exit code.

    Raises:
        RulesError: the game cannot be loaded.
        SceneError: its scene cannot be used.
    """
    parser = Parser(
        prog="sovereign-server describe",
        description="Prints the scene, commands, events, attributes, behaviours and hooks of a game.",
        allow_abbrev=False,
    )
    parser.add_argument("--game", required=True, metavar="MODULE:CLASS", help="class with the rules of the game")
    parser.add_argument("--scene", help="scene to play (default: the game's own)")
    options = parser.flags(arguments)
    rules = load_rules(options["game"])
    scene = prepared(rules, load_scene(options["scene"] or rules.scene or "hills"))
    print(options["game"], *described(rules, scene), sep="\n")
    return 0


def described(rules: Rules, scene: Scene) -> Iterator[str]:
    """Yields the lines of the description of a game.

    Args:
        rules: the rules.
        scene: the scene that they play, prepared.
    """
    blocks = " x ".join(str(32 * part) for part in scene.size)
    yield _line("scene", f"{scene.name}, {blocks} blocks, {scene.tick_rate} ticks/s")
    yield _line("templates", ", ".join(template.name for template in scene.templates))
    keys = rules.keys
    yield _line("buttons", ", ".join(name + (f" ({keys[name]})" if name in keys else "") for name in scene.buttons))
    if scene.aim:
        yield _line("aim", "each input has a direction in space")
    if scene.kinds:
        yield _line("blocks", ", ".join(kind.name + ("" if kind.solid else " (not solid)") for kind in scene.kinds))
    yield _line("hooks", ", ".join(name for name in HOOKS if overrides(rules, name)) or "none")
    for name, value in rules.options.items():
        yield _line("option", _field(name, value))
    for name, fields in rules.commands.items():
        yield _line("command", f"{name}({', '.join(_field(key, value) for key, value in fields.items())})")
    for title, texts in (("event", rules.events), ("attribute", rules.attributes)):
        for name, meaning in texts.items():
            yield _line(title, f"{name}: {meaning}")
    for entry in scene.behaviours:
        yield _line("behaviour", _behaviour(entry))


def _field(name: str, value: Value) -> str:
    default = "" if value.default is REQUIRED else f" = {value.default!r}"
    return f"{name}: {value.description}{default}"


def _behaviour(entry: BehaviourEntry) -> str:
    fields = [f"{each.name} {each.low} to {each.high}, from {each.start}" for each in entry.fields]
    return f"{entry.name} of {', '.join(entry.templates)}" + (f": {'; '.join(fields)}" if fields else "")


def _line(name: str, text: str) -> str:
    return f"  {name:<{WIDTH}}{text}"
