"""The composition root: makes a server from settings, runs it until a signal, and shuts it down."""

import asyncio
import contextlib
import dataclasses
import os
import signal
import sys
from collections.abc import Callable, Sequence

from server import describe
from server.auth.access import authenticator, operator_token
from server.config.options import SettingsError, nearest
from server.config.settings import Settings, parse
from server.game import Game
from server.persistence.database import StoreError
from server.play.play import play_pages
from server.rules import Rules, RulesError, load_rules, prepared
from server.runtime import healthcheck, log, reload
from server.runtime.event_loop import (
    announce_compiling,
    leave,
    loop_factory,
    signals,
)
from server.runtime.keeping import recorded, saved
from server.runtime.structured import structlog
from server.runtime.terrain import TerrainPool
from server.runtime.warmup import warm_up
from server.serving import Declared, Server
from shared import kernels
from shared.checks import SceneError
from shared.scene import load_scene


def _token(arguments: Sequence[str]) -> int:
    from server.auth import tokens  # its library takes a tenth of a server's start

    return tokens.main(arguments)


def _worlds(arguments: Sequence[str]) -> int:
    from server.hosting import command  # a server with one world does not need it

    return command.main(arguments)


COMMANDS = {"token": _token, "check": healthcheck.main, "describe": describe.main, "worlds": _worlds}
"""Functions of the other commands of `sovereign-server`, by name."""

logger = structlog.stdlib.get_logger("server")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a server until a signal, or runs another command. Returns the exit code.

    Args:
        arguments: the command line without the program's name; None: that of this process.
    """
    for number in signals():
        signal.signal(number, leave)  # until the event loop takes over
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments and not arguments[0].startswith("-"):
            return command(arguments[0])(arguments[1:])
        settings = parse(arguments)
        if isinstance(settings, str):
            print(settings, end="")
            return 0
        return reload.serve(settings, arguments) if settings.reload else run(settings)
    except (SettingsError, SceneError, StoreError, RulesError) as error:
        print("error:", *str(error).split(), file=sys.stderr)
        return 2


def command(name: str) -> Callable[[Sequence[str]], int]:
    """Returns the function of a command other than the server itself; it takes arguments and returns the exit code.

    Raises:
        SettingsError: there is no such command.
    """
    if name not in COMMANDS:
        *others, last = COMMANDS
        there = f"{', '.join(others)} and {last}"
        raise SettingsError(
            f"{name!r}: no such command{nearest(name, COMMANDS)}; the commands are {there}; "
            "to start a server, give only flags (--help)"
        )
    return COMMANDS[name]


def run(settings: Settings) -> int:
    """Serves the default world, and many others if the settings declare kinds, until a signal. Returns the exit code.

    Raises:
        RulesError: the rules cannot be used.
        SceneError: the scene cannot be used.
        SettingsError: the address or one of the files cannot be used.
        StoreError: the saved world cannot be used.
    """
    log.set_up(settings.log_level, settings.log_format, sys.stderr)
    authenticate = authenticator(settings)
    rules = Rules() if settings.game is None else load_rules(settings.game, settings.options)
    scene = load_scene(settings.scene if "scene" in settings.origins else rules.scene or settings.scene)
    if settings.tick_rate is not None:
        scene = dataclasses.replace(scene, tick_rate=settings.tick_rate)
    if settings.reach is not None:
        scene = dataclasses.replace(scene, reach=settings.reach)
    scene = prepared(rules, scene)
    kinds, token = {}, operator_token(settings.operator_token_file, os.environ)
    if settings.worlds:
        from server.hosting.declared import declared_kinds  # a server with one world does not need its libraries

        kinds = declared_kinds(settings)
    kernels.force(settings.kernel)
    if settings.kernel == kernels.AUTO and kernels.trouble():
        logger.warning("the physics is slower, or has to be compiled", kernel=kernels.describe())
    with kernels.compiling(lambda: announce_compiling(sys.stderr)):
        terrain = TerrainPool()
        world = warm_up(scene, terrain.world(scene) if kinds else None)
        for other in {kind.scene.fingerprint: kind.scene for kind in kinds.values()}.values():
            warm_up(other, terrain.world(other))
    if settings.role != "server":
        from server.roles import run_part  # a server in one process does not need its libraries

        return run_part(settings, scene, rules, world, authenticate)
    with asyncio.Runner(loop_factory=loop_factory()) as runner, contextlib.ExitStack() as stack:
        store = None
        if settings.data is not None and settings.fleet is None:
            store = stack.enter_context(saved(scene, settings))
            world = store.world
        if settings.record is not None:
            world = stack.enter_context(recorded(scene, settings.record, world))
        game = Game(
            scene,
            limits=settings.limits,
            world=world,
            saves=store,
            rules=rules,
            seed=settings.seed,
            authenticate=authenticate,
        )
        others = [(kind.name, kind.scene, kind.rules()) for kind in kinds.values()] if settings.play else []
        play = play_pages(settings, [(settings.game or scene.name, scene, rules), *others])
        more = Declared(kinds, terrain, token) if kinds else None
        if settings.fleet is not None and more is not None:
            from server.fleet import run_fleet  # a server alone does not need its libraries

            return runner.run(run_fleet(settings, game, more, play))
        return runner.run(Server(settings, game, store, more, play).serve())
