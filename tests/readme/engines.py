"""Engines without a window, and the least that stands in for those that are not installed."""

import importlib.util
import os
import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any


def module(name: str, **names: Any) -> ModuleType:
    """Makes a module that can be imported."""
    made = ModuleType(name)
    made.__dict__.update(names)
    sys.modules[name] = made
    parent, _, child = name.rpartition(".")
    if parent:
        setattr(sys.modules[parent], child, made)
    return made


def ever(frame: Callable[[], object]) -> None:
    """An engine's loop: whoever has had enough raises."""
    while True:
        frame()


class Thing:
    """Takes every call and every attribute; notes what has been drawn or placed."""

    drawn = 0

    def __init__(self, *args: Any, **more: Any) -> None:
        pass

    def __setattr__(self, name: str, value: Any) -> None:
        Thing.drawn += name == "position"

    def draw(self, *args: Any) -> None:
        Thing.drawn += 1

    setPos = draw  # noqa: N815  # as Panda3D has it

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *args, **more: Thing()


def pyglet() -> None:
    frames: list[Callable[[float], None]] = []
    draws: list[Callable[[], None]] = []

    class Window(Thing):
        def event(self, call: Callable[[], None]) -> None:
            assert call.__name__ == "on_draw"
            draws.append(call)

    class Held(dict[int, bool]):
        def __missing__(self, key: int) -> bool:
            return False

    def loop() -> None:
        ever(lambda: (frames[0](1 / 60), draws[0]()))

    module("pyglet")
    module("pyglet.window", Window=Window)
    module("pyglet.window.key", KeyStateHandler=Held, A=97, D=100, S=115, W=119, SPACE=32)
    module("pyglet.shapes", Circle=Thing)
    module("pyglet.clock", schedule_interval=lambda call, every: frames.append(call))
    module("pyglet.app", run=loop)


def arcade() -> None:
    windows: list[Any] = []

    class Window:
        def __init__(self, width: int, height: int) -> None:
            windows.append(self)

        def clear(self) -> None:
            pass

    def loop() -> None:
        windows[0].on_key_press(100, 0)
        windows[0].on_key_release(100, 0)
        ever(lambda: (windows[0].on_update(1 / 60), windows[0].on_draw()))

    color = SimpleNamespace(WHITE=(255, 255, 255))
    module("arcade", Window=Window, run=loop, draw_circle_filled=Thing().draw, color=color)
    module("arcade.key", A=97, D=100, S=115, W=119, SPACE=32)


def panda3d() -> None:
    tasks: list[Callable[[Any], Any]] = []

    class ShowBase:
        loader = render = camera = Thing()
        taskMgr = SimpleNamespace(add=lambda call, name: tasks.append(call))  # noqa: N815  # as Panda3D has it

        def accept(self, key: str, call: Callable[..., None], more: list[Any]) -> None:
            call(*more)

        def disableMouse(self) -> None:  # noqa: N802  # likewise
            pass

        def run(self) -> None:
            ever(lambda: tasks[0](SimpleNamespace(cont=1)))

    module("direct")
    module("direct.showbase")
    module("direct.showbase.ShowBase", ShowBase=ShowBase)


def ursina() -> None:
    entities: list[Any] = []

    class Entity(Thing):
        def __init__(self, **more: Any) -> None:
            entities.append(self)

        def update(self) -> None:
            pass

    class Ursina:
        def run(self) -> None:
            ever(lambda: [entity.update() for entity in list(entities)])

    held = dict.fromkeys(["w", "a", "s", "d", "space"], 0)
    module("ursina", Entity=Entity, Ursina=Ursina, camera=Thing(), destroy=entities.remove, held_keys=held)


def prepare(engine: str) -> bool:
    """Makes an engine run without a display; whether it is the real one."""
    os.environ |= {"SDL_VIDEODRIVER": "dummy", "PYGAME_HIDE_SUPPORT_PROMPT": "1", "ARCADE_HEADLESS": "True"}
    package = {"pygame-ce": "pygame", "Panda3D": "direct"}.get(engine, engine)
    if importlib.util.find_spec(package) is None:
        {"pyglet": pyglet, "arcade": arcade, "Panda3D": panda3d, "ursina": ursina}[engine]()
        return False
    if engine == "pyglet":
        importlib.import_module("pyglet").options["headless"] = True
    if engine in ("Panda3D", "ursina"):
        core = importlib.import_module("panda3d.core")
        core.loadPrcFileData("", "window-type offscreen\nload-display p3tinydisplay\naudio-library-name null")
    if engine == "ursina":
        real: Any = importlib.import_module("ursina")
        without = real.Ursina
        real.Ursina = lambda: without(window_type="offscreen", development_mode=False)
    return True
