"""Engines without a window, minimal stand-ins for engines that are not installed, and a look at the figures they
show."""

import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

Point = tuple[float, float]
Standing = tuple[Callable[[], list[Point]], Callable[[], object]]
"""Functions of a stand-in: one returns where figures are shown, one presses and releases the space bar at once."""
FIGURE_PIXELS = 5
"""Least width of a figure in pixels; the lines on the ground are narrower."""


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
    """Runs an engine's loop. It ends by an exception."""
    while True:
        frame()


class Thing:
    """An object that accepts every call and every attribute."""

    def __init__(self, *args: Any, **more: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *args, **more: Thing()


class Flat:
    """Circles that a stand-in for a 2D engine has drawn since it cleared its window."""

    circles: ClassVar[list[Point]] = []
    size = (0, 0)

    @classmethod
    def clear(cls) -> None:
        cls.circles = []

    @classmethod
    def draw(cls, x: float, y: float, radius: float, colour: object = None) -> None:
        cls.circles.append((x, y))

    @classmethod
    def lit(cls) -> list[Point]:
        """Returns the centres of circles, in heights of the window, from its middle."""
        width, height = cls.size
        return [(x / height - width / height / 2, y / height - 0.5) for x, y in cls.circles]


class Body(Thing):
    """A body of a stand-in for a 3D engine; x east, y north, z up."""

    bodies: ClassVar[list["Body"]] = []
    camera: "Body"

    def __init__(self, *args: Any, **more: Any) -> None:
        self.at = (0.0, 0.0, 0.0)
        Body.bodies.append(self)

    def setPos(self, x: float, y: float, z: float) -> None:  # noqa: N802  # as Panda3D has it
        self.at = (x, y, z)

    def removeNode(self) -> None:  # noqa: N802  # likewise
        Body.bodies.remove(self)

    @classmethod
    def lit(cls) -> list[Point]:
        """Returns where the camera, which looks straight down, sees the bodies."""
        (x, y, z), seen = cls.camera.at, [body.at for body in cls.bodies if body is not cls.camera]
        assert all(z > above for _, _, above in seen), "the camera is above all bodies"
        return [((east - x) / (z - above), (north - y) / (z - above)) for east, north, above in seen]


def pyglet() -> Standing:
    frames: list[Callable[[float], None]] = []
    calls: dict[str, Callable[..., None]] = {}

    class Window(Thing):
        def __init__(self, width: int, height: int) -> None:
            Flat.size = width, height

        def event(self, call: Callable[..., None]) -> None:
            assert call.__name__ in ("on_draw", "on_key_press")
            calls[call.__name__] = call

        def clear(self) -> None:
            Flat.clear()

    class Circle:
        def __init__(self, *args: float) -> None:
            self.args = args

        def draw(self) -> None:
            Flat.draw(*self.args)

    class Held(dict[int, bool]):
        def __missing__(self, key: int) -> bool:
            return False

    def loop() -> None:
        ever(lambda: (frames[0](1 / 60), calls["on_draw"]()))

    module("pyglet")
    module("pyglet.window", Window=Window)
    module("pyglet.window.key", KeyStateHandler=Held, A=97, D=100, S=115, W=119, SPACE=32)
    module("pyglet.shapes", Circle=Circle, Line=Thing)
    module("pyglet.clock", schedule_interval=lambda call, every: frames.append(call))
    module("pyglet.app", run=loop)
    return Flat.lit, lambda: calls["on_key_press"](32, 0)


def arcade() -> Standing:
    windows: list[Any] = []

    class Window:
        def __init__(self, width: int, height: int) -> None:
            Flat.size = width, height
            windows.append(self)

        def clear(self) -> None:
            Flat.clear()

    def loop() -> None:
        windows[0].on_key_press(100, 0)
        windows[0].on_key_release(100, 0)
        ever(lambda: (windows[0].on_update(1 / 60), windows[0].on_draw()))

    color = SimpleNamespace(WHITE=(255, 255, 255))
    module("arcade", Window=Window, run=loop, draw_circle_filled=Flat.draw, draw_line=Thing, color=color)
    module("arcade.key", A=97, D=100, S=115, W=119, SPACE=32)

    def tap() -> None:
        windows[0].on_key_press(32, 0)
        windows[0].on_key_release(32, 0)

    return Flat.lit, tap


def panda3d() -> Standing:
    tasks: list[Callable[[Any], Any]] = []
    keys: dict[str, Callable[[], None]] = {}
    Body.camera = Body()

    class ShowBase:
        camera, render = Body.camera, Thing()
        loader = SimpleNamespace(loadModel=Body)
        taskMgr = SimpleNamespace(add=lambda call, name: tasks.append(call))  # noqa: N815  # as Panda3D has it

        def accept(self, key: str, call: Callable[..., None], more: list[Any]) -> None:
            keys[key] = lambda: call(*more)

        def disableMouse(self) -> None:  # noqa: N802  # likewise
            pass

        def run(self) -> None:
            ever(lambda: tasks[0](SimpleNamespace(cont=1)))

    module("direct")
    module("direct.showbase")
    module("direct.showbase.ShowBase", ShowBase=ShowBase)
    module("panda3d")
    module("panda3d.core", LineSegs=Thing)
    return Body.lit, lambda: (keys["space"](), keys["space-up"]())


def ursina() -> Standing:
    games: list[Any] = []

    class Entity:
        def __init__(self, **more: Any) -> None:
            self._body = Body() if more.get("model") in ("cube", "camera") else None
            if not more:
                games.append(self)

        def __setattr__(self, name: str, value: Any) -> None:
            if name == "position" and self._body is not None:
                x, up, north = value
                self._body.setPos(x, north, up)
            object.__setattr__(self, name, value)

    class Ursina:
        def run(self) -> None:
            ever(lambda: [game.update() for game in games])

    def destroy(entity: Entity) -> None:
        assert entity._body is not None
        entity._body.removeNode()

    camera, held = Entity(model="camera"), dict.fromkeys(["w", "a", "s", "d", "space"], 0)
    assert camera._body is not None
    Body.camera = camera._body
    names = {"Entity": Entity, "Ursina": Ursina, "camera": camera, "destroy": destroy, "held_keys": held}
    module("ursina", **names, Grid=lambda width, height: "grid", color=SimpleNamespace(gray=None))
    return Body.lit, lambda: [game.input(key) for game in games for key in ("space", "space up")]


def shown(engine: str) -> list[Point]:
    """Returns where a real engine shows anything but its background and thin lines.

    Places are in heights of its window, from the middle: x to the right, y up.
    """
    pixels = _pixels(engine)
    colours, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
    lit = (abs(pixels.astype(int) - colours[counts.argmax()].astype(int)) > 12).any(axis=2)
    for axis in (0, 1):
        lit = np.logical_and.reduce([np.roll(lit, by, axis) for by in range(FIGURE_PIXELS)])
    height, width = lit.shape
    back = (FIGURE_PIXELS - 1) / 2  # a figure's pixels are marked at their last one
    return [
        ((x - back + 0.5 - width / 2) / height, 0.5 - (y - back + 0.5) / height) for y, x in np.argwhere(lit).tolist()
    ]


def _pixels(engine: str) -> npt.NDArray[np.uint8]:
    """Returns the picture in the window, [row from the top, column, colour]."""
    if engine == "pygame-ce":
        import pygame

        surface = pygame.display.get_surface()
        assert surface is not None
        found: npt.NDArray[np.uint8] = pygame.surfarray.array3d(surface).transpose(1, 0, 2)
        return found
    if engine in ("Panda3D", "ursina"):
        base: Any = importlib.import_module("builtins")
        texture = base.base.win.getScreenshot()
        size = texture.getYSize(), texture.getXSize(), texture.getNumComponents()
        return np.frombuffer(bytes(texture.getRamImage()), np.uint8).reshape(size)[::-1, :, :3]
    if engine == "arcade":
        return np.asarray(importlib.import_module("arcade").get_image())[:, :, :3]
    image = importlib.import_module("pyglet.image").get_buffer_manager().get_color_buffer().get_image_data()
    data = image.get_data("RGB", 3 * image.width)
    return np.frombuffer(data, np.uint8).reshape(image.height, image.width, 3)[::-1]


def _tap_pygame() -> None:
    import pygame

    for kind in (pygame.KEYDOWN, pygame.KEYUP):
        pygame.event.post(pygame.event.Event(kind, key=pygame.K_SPACE))


def prepare(engine: str) -> tuple[bool, Callable[[], list[Point]], Callable[[], object] | None]:
    """Makes an engine run without a display.

    Returns:
        Whether it is the real engine, a function that returns where figures are shown, and one that presses and
        releases the space bar between two frames, if there is a way to.
    """
    os.environ |= {"SDL_VIDEODRIVER": "dummy", "PYGAME_HIDE_SUPPORT_PROMPT": "1", "ARCADE_HEADLESS": "True"}
    package = {"pygame-ce": "pygame", "Panda3D": "direct"}.get(engine, engine)
    if importlib.util.find_spec(package) is None:
        return False, *{"pyglet": pyglet, "arcade": arcade, "Panda3D": panda3d, "ursina": ursina}[engine]()
    if engine == "pyglet":
        importlib.import_module("pyglet").options["headless"] = True
    if engine in ("Panda3D", "ursina"):
        core = importlib.import_module("panda3d.core")
        core.loadPrcFileData("", "window-type offscreen\nload-display p3tinydisplay\naudio-library-name null")
    if engine == "ursina":
        real: Any = importlib.import_module("ursina")
        without = real.Ursina
        real.Ursina = lambda: without(window_type="offscreen", development_mode=False)
    return True, lambda: shown(engine), _tap_pygame if engine == "pygame-ce" else None
