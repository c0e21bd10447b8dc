"""The window: draws a client's view of the world, and reads the player's keyboard and mouse."""

import functools
import math
from collections.abc import Mapping
from typing import NamedTuple, Protocol

import pygame

from client_sdk.client import Client
from client_sdk.events import (
    Answered,
    Disconnected,
    Diverged,
    Event,
    Happened,
    Joined,
    Left,
    Moved,
    Resumed,
    Waiting,
)
from client_sdk.netsim.links import Link
from client_sdk.view import EntityView, View
from server.declared import Value
from shared.buttons import JUMP_NAME
from shared.checks import Cell, Vec
from shared.scene import Scene
from sovereign_netcode.play.chat import COMMAND, FIELD, Chat
from sovereign_netcode.play.figures import (
    INK,
    OWN,
    TONES,
    WHITE,
    Actor,
    colour_named,
    draw_ghost,
    font,
    label,
    look_of,
    screen,
)
from sovereign_netcode.play.hud import Hud
from sovereign_netcode.play.iso import (
    CHOICE,
    FIRST_KIND,
    Colour,
    Ground,
    Point,
    colour_of,
    project,
    target_of,
    top_of,
    unproject,
)
from sovereign_netcode.play.keys import Keys, commands_of
from sovereign_netcode.play.panel import Panel
from sovereign_netcode.play.texts import points_text, sentence

SIZE = 1280, 800
SKY = (122, 184, 232), (222, 240, 250)
LAG_STEP_S, LAG_MAX_S = 0.05, 1.0
CLOSED = "closed by the player"
FETCHES, WAITS = "fetching the world ...", "waiting for a world ..."
"""Reason of the end (`Window.over`) when the player has closed the window."""
DIG, PLACE = -1, -3
"""Numbers of the mouse buttons that remove and place blocks, unless the game has them for its own buttons."""
EYES = 1.1
"""Height above its position from which a figure aims, in blocks."""
KEYS: dict[int, Point] = {
    pygame.K_w: (-1, 1), pygame.K_UP: (-1, 1), pygame.K_s: (1, -1), pygame.K_DOWN: (1, -1),
    pygame.K_d: (1, 1), pygame.K_RIGHT: (1, 1), pygame.K_a: (-1, -1), pygame.K_LEFT: (-1, -1),
}  # fmt: skip
"""Direction (east, north) of each key. North-west is up on the screen."""


class Wish(NamedTuple):
    """A direction (east, north), whether to jump, the buttons that are held, and the aim."""

    x: float = 0.0
    y: float = 0.0
    jump: bool = False
    buttons: tuple[str, ...] = ()
    aim: Vec | None = None


REST = Wish(0.0, 0.0, False, (), None)
"""Wish of a player who types a message."""


class Pilot(Protocol):
    """The source of a player's inputs: a person at the keyboard, or a script."""

    def __call__(self, window: "Window", view: View, now: float) -> Wish:
        """Returns the input from now on. It is called once per frame while playing."""


class Window:
    """One player's window.

    Args:
        client: a client that is connecting or has joined; the keys [ and ] change its simulated link.
        pilot: decides on the inputs.
        title: text at the top of the window.
        keys: names of the keys of the game's buttons, and of its commands without fields (`Rules.keys`).
        commands: the commands that the rules declare (`Rules.commands`).
    """

    def __init__(
        self,
        client: Client,
        pilot: Pilot,
        title: str,
        keys: Mapping[str, str] | None = None,
        commands: Mapping[str, Mapping[str, Value]] | None = None,
    ) -> None:
        self.client, self.core, self.title = client, client.core, title
        self.events: list[Event] = []
        """Events of the latest frame."""
        self.pressed: set[int] = set()
        """Keys, and with a minus mouse buttons, that went down since the frame before."""
        self.actors: list[Actor] = []
        """All figures in sight."""
        self.panel = Panel()
        self.ghost = False
        self.lag_s = 0.0
        self.kind = FIRST_KIND
        self.over = ""
        """Reason of the session's end; empty while it lasts."""
        self.code = 0
        """Close code of the session's end."""
        self._pilot, self._wanted = pilot, keys or {}
        self.chat = Chat(commands or {})
        self._commands = commands_of(self._wanted, commands or {})
        self._keys: tuple[Scene, Keys] | None = None
        font.cache_clear()  # those of a window before this one, if pygame was ended meanwhile
        self._screen = pygame.display.set_mode(SIZE, pygame.RESIZABLE)
        self._ground, self._hud = Ground(), Hud(LAG_MAX_S)
        self._camera: Point | None = None
        self._fetching = FETCHES
        self._headings: dict[int, Point] = {}
        self._tones: dict[int, int] = {}
        self._at = 0.0
        pygame.display.set_caption(f"{title} - Sovereign Netcode")

    # -- a frame ---------------------------------------------------------------------------------------------

    def frame(self, now: float) -> None:
        """Runs one frame: receives, reads the input, predicts, and draws."""
        self.events = self.client.poll(now)
        view = self.client.view(now)
        for event in self.events:
            self._take(event, view, now)
        self.pressed.clear()
        for act in pygame.event.get():
            self._handle(act, view)
        if self.client.playing:
            x, y, jump, buttons, aim = self._pilot(self, view, now) if self.chat.text is None else REST
            self.client.set_input(x, y, jump=jump, buttons=buttons, aim=aim)
        self.client.update(now)
        self._draw(self.client.view(now), now)
        self._at = now

    def lag(self, seconds: float) -> None:
        """Sets the latency that the simulated link adds to the round trip."""
        self.lag_s = seconds
        self.client.link = Link(seconds / 2) if seconds else None

    @property
    def keys(self) -> Keys:
        """The keys of the scene's buttons."""
        scene = self.core.scene
        if scene is None:
            return Keys((), {})
        if self._keys is None or self._keys[0] is not scene:
            self._keys = scene, Keys(scene.buttons, self._wanted)
        return self._keys[1]

    @property
    def sliding(self) -> bool:
        """Whether the mouse holds the slider of the latency."""
        return self._hud.slider.held

    def save(self, path: str) -> None:
        """Saves the window's content to an image file."""
        pygame.image.save(self._screen, path)

    def shown(self, place: Vec, margin: int = 120) -> bool:
        """Returns whether a position, in blocks, is at least `margin` pixels inside the window."""
        area = self._screen.get_rect().inflate(-2 * margin, -2 * margin)
        return self._camera is not None and area.collidepoint(screen(place, self._camera))

    # -- events and keys -------------------------------------------------------------------------------------

    def _take(self, event: Event, view: View, now: float) -> None:
        match event:
            case Left(reason=reason, code=code):
                self.over, self.code = self.over or reason, code
            case Happened(name=name, data=data):
                self._hud.say(sentence(name, data, view), now)
            case Answered(done=False, verdict=verdict):
                self._hud.say(f"rejected: {verdict}", now)
            case Disconnected(reason=reason, wait_s=wait_s):
                self._hud.say(f"connection lost ({reason}): reconnecting in {wait_s:.0f} s", now)
            case Waiting(position=position, waiting=waiting):
                self._fetching = f"waiting for a world: {position} of {waiting} ..." if waiting else WAITS
            case Moved(reason=reason):
                self._hud.say(reason or "to another world", now)
            case Joined():  # perhaps in another world than before
                self._ground, self._camera, self._fetching = Ground(), None, FETCHES
            case Resumed(away_s=away_s):
                self._hud.say(f"reconnected after {away_s:.1f} s", now)
            case Diverged(what=what):
                self._hud.say(f"ALARM: the predicted world differs from the server's: {what}", now)
            case _:
                pass

    def _handle(self, event: pygame.event.Event, view: View) -> None:
        lag_s = self._hud.slider.handle(event)
        typed, message = self.chat.handle(event)
        if message and self.client.playing:
            self.client.command(COMMAND, {FIELD: message})
        if typed:
            return
        if lag_s is not None:
            self.lag(lag_s)
        elif event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
            self.over = CLOSED
        elif event.type == pygame.KEYDOWN:
            self.pressed.add(event.key)
            if event.key == pygame.K_g:
                self.ghost = not self.ghost
            elif event.key == pygame.K_F3:
                self.panel.shown = not self.panel.shown
            elif event.key == pygame.K_LEFTBRACKET:
                self.lag(max(self.lag_s - LAG_STEP_S, 0.0))
            elif event.key == pygame.K_RIGHTBRACKET:
                self.lag(min(self.lag_s + LAG_STEP_S, LAG_MAX_S))
            elif event.key in self._commands and self.client.playing:
                self.client.command(self._commands[event.key])
            elif pygame.K_1 <= event.key < pygame.K_1 + len(CHOICE):
                self.kind = FIRST_KIND + event.key - pygame.K_1
        elif event.type == pygame.MOUSEBUTTONDOWN:
            self.pressed.add(-event.button)
            if -event.button in (DIG, PLACE) and -event.button not in self.keys:
                found = self._pointed(view)
                if found is not None and self.client.playing:
                    cell, kind = (found[0], 0) if -event.button == DIG else (found[1], self.kind)
                    self.client.edit(*cell, kind)

    def _pointed(self, view: View) -> tuple[Cell, Cell] | None:
        """Returns the block under the mouse and the free cell in front of it; None if there is none within reach."""
        prediction = self.core.prediction
        if prediction is None or view.me is None or self._camera is None:
            return None
        x, y = pygame.mouse.get_pos()
        found = target_of(prediction.predicted.blocks, (x + self._camera[0], y + self._camera[1]), view.me.position[2])
        if found is None:
            return None
        centre = [part + 0.5 for part in found[0]]
        return found if math.dist(centre, view.me.position) <= prediction.predicted.scene.reach else None

    def aim(self, view: View) -> Vec | None:
        """Returns the direction from the own figure to what is under the mouse; None if there is no own figure."""
        prediction = self.core.prediction
        if prediction is None or view.me is None or self._camera is None:
            return None
        x, y, z = view.me.position
        mouse = pygame.mouse.get_pos()
        at = mouse[0] + self._camera[0], mouse[1] + self._camera[1]
        found = target_of(prediction.predicted.blocks, at, z)
        if found is None:
            east, north = unproject(*at, z)
            return east - x, north - y, 0.0
        return found[1][0] + 0.5 - x, found[1][1] + 0.5 - y, found[1][2] + EYES - (z + EYES)

    # -- drawing ---------------------------------------------------------------------------------------------

    def _draw(self, view: View, now: float) -> None:
        target, prediction, scene = self._screen, self.core.prediction, self.core.scene
        target.blit(_sky(target.get_size()), (0, 0))
        if view.me is None or prediction is None or scene is None:
            plate = label(self._fetching, INK, WHITE, 30)
            target.blit(plate, plate.get_rect(center=target.get_rect().center))
            pygame.display.flip()
            return
        blocks = prediction.predicted.blocks
        first = not self._ground.pictures
        self._ground.refresh(blocks, 999 if first else 1)
        camera = self._follow(view.me.position, now)
        self._ground.draw(target, camera)
        pointed = self._pointed(view)
        if pointed is not None:
            rim = [(round(x - camera[0]), round(y - camera[1])) for x, y in top_of(pointed[0])]
            pygame.draw.polygon(target, WHITE, rim, 2)
        self.actors = self._cast(view)
        for actor in sorted(self.actors, key=lambda actor: actor.depth):
            actor.draw(target, camera, self._ground, blocks.get)
        if self.ghost and view.me.entity in prediction.confirmed:
            at = prediction.confirmed.position(view.me.entity)
            draw_ghost(target, camera, at, view.me.position, look_of(self._heading(view.me)))
        for actor in self.actors:
            actor.draw_name(target, camera)
        ends = self.client.shared.get("ends")
        left_s = max(ends - view.tick, 0.0) / scene.tick_rate if isinstance(ends, int) else None
        self._hud.draw(
            target,
            now,
            title=f"{self.title}{points_text(self.client.shared.get('points'))}",
            keys="    ".join(part for part in (self.keys.text(), "Enter: say" if self.chat.there else "") if part),
            edits=scene.reach > 0,
            left_s=left_s,
            actors=self.actors,
            network=self.client.stats.figures(),
            lag_s=self.lag_s,
            choice=colour_of(self.kind),
        )
        self.panel.draw(target, self.client)
        self.chat.draw(target)
        pygame.display.flip()

    def _cast(self, view: View) -> list[Actor]:
        """Returns the figures in sight, with their state in the game."""
        found = []
        scene = self.core.scene
        assert scene is not None
        for figure in view.figures:
            own = figure is view.me
            safe = figure.attributes.get("safe", 0)
            safe = isinstance(safe, int) and safe > view.tick
            team = figure.attributes.get("team", figure.fields.get("team"))
            tone = colour_named(figure.attributes.get("colour"))
            if tone is None:
                tone = TONES[team % len(TONES)] if isinstance(team, int) else OWN if own else self._tone(figure.entity)
            template = scene.templates[scene.index_of[figure.template]]
            person = template.box_size == scene.templates[scene.index_of[scene.player]].box_size
            heading = self._heading(figure)
            it = figure.template == "it"
            found.append(Actor(figure, template, tone, heading, it=it, own=own, safe=safe, person=person))
        seen = {actor.figure.entity for actor in found}
        self._tones = {entity: tone for entity, tone in self._tones.items() if entity in seen}
        self._headings = {entity: way for entity, way in self._headings.items() if entity in seen}
        return found

    def _tone(self, entity: int) -> Colour:
        """Returns a figure's colour, which stays while it is in sight, and is unique while there are enough colours."""
        if entity not in self._tones:
            counts = [0] * len(TONES)
            for tone in self._tones.values():
                counts[tone] += 1
            self._tones[entity] = counts.index(min(counts))
        return TONES[self._tones[entity]]

    def _heading(self, figure: EntityView) -> Point:
        """Returns the direction (east, north) in which a figure last moved."""
        vx, vy, _ = figure.velocity
        if vx or vy:
            self._headings[figure.entity] = vx, vy
        return self._headings.get(figure.entity, (1.0, -1.0))

    def _follow(self, me: Vec, now: float) -> Point:
        """Moves the camera smoothly towards the player's own figure. Returns its position."""
        width, height = self._screen.get_size()
        x, y = project(*me)
        wanted = x - width / 2, y - height / 2 - 20
        if self._camera is None:
            self._camera = wanted
        share = 1 - math.exp(-6 * max(now - self._at, 0.0))
        old = self._camera
        self._camera = old[0] + (wanted[0] - old[0]) * share, old[1] + (wanted[1] - old[1]) * share
        return self._camera


def keyboard(window: Window, view: View, now: float) -> Wish:
    """Returns the input of the keys that are held; a button also counts if its key went down and up again."""
    held, mouse = pygame.key.get_pressed(), pygame.mouse.get_pressed()

    def down(code: int) -> bool:
        if code < 0 and window.sliding:
            return False
        return code in window.pressed or (held[code] if code > 0 else mouse[-code - 1])

    x = sum(way[0] for key, way in KEYS.items() if held[key])
    y = sum(way[1] for key, way in KEYS.items() if held[key])
    length = math.hypot(x, y) or 1.0
    scene, buttons = window.core.scene, window.keys.held(down)
    aims = scene is not None and scene.aim and any(button != JUMP_NAME for button in buttons)  # an aim costs bytes
    jump = scene is not None and JUMP_NAME not in scene.buttons and down(pygame.K_SPACE)
    return Wish(x / length, y / length, jump, buttons, window.aim(view) if aims else None)


@functools.lru_cache(1)
def _sky(size: tuple[int, int]) -> pygame.Surface:
    """Returns a picture of the sky: a gradient from top to bottom."""
    strip = pygame.Surface((1, 2))
    strip.set_at((0, 0), SKY[0])
    strip.set_at((0, 1), SKY[1])
    return pygame.transform.smoothscale(strip.convert(), size)
