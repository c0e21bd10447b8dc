"""Worlds with their host, whose ticks run when a test says so, and clients with fake links."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from server.config.settings import Settings, parse
from server.game import Game
from server.game.loading import at_once
from server.hosting.declared import declared_kinds
from server.hosting.host import WorldHost
from server.rules import Rules
from server.runtime.alarm import SharedTimer
from server.runtime.terrain import TerrainPool
from server.worlds.worlds import Worlds
from shared import messages
from shared.messages import Bye, Hello, Message, decode_from_server, encode
from shared.scene import load_scene

HERE = "tests.server.hosting.bench"
PLAIN = '[worlds.plain]\nscene = "arena"\nempty_s = 5\n'
KEEPING = '[worlds.keeping]\nscene = "arena"\nempty_s = 5\nkeep = true\n'
GAMES = f'[worlds.duel]\ngame = "{HERE}:Match"\nscene = "arena"\nempty_s = 5\n'
BROKEN = f'[worlds.broken]\ngame = "{HERE}:Broken"\nscene = "arena"\n'


class Match(Rules):
    """Rules that count ticks."""

    def on_start(self) -> None:
        self.ticks = 0

    def on_tick(self) -> None:
        self.ticks += 1


class Broken(Rules):
    """Rules that cannot be made if `fails` is true."""

    fails = False

    def __init__(self) -> None:
        if self.fails:
            raise OSError("no licence")


class Alarm:
    """A timer that rings when the test says so."""

    all: list["Alarm"]

    def __init__(self, ring: Callable[[], None]) -> None:
        self.ring, self.at = ring, -1.0
        Alarm.all.append(self)

    def set(self, at: float) -> None:
        self.at = at

    def close(self) -> None:
        Alarm.all.remove(self)


class Link:
    """A client's connection that keeps what the server sends."""

    def __init__(self) -> None:
        self.sent: list[Message] = []
        self.closings: list[tuple[int, str]] = []

    def send(self, message: bytes) -> None:
        self.sent.append(decode_from_server(message))

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        self.closings.append((code, reason))

    @property
    def bye(self) -> Bye:
        """The message with which the server closed the connection."""
        assert isinstance(self.sent[-1], Bye)
        return self.sent[-1]


class Bench:
    """A server's worlds without its sockets.

    Args:
        folder: folder for the settings.
        text: tables of the settings.
        data: folder of the saved worlds; None: they are not saved.
    """

    def __init__(self, folder: Path, text: str, data: Path | None = None, **limits: Any) -> None:
        file = folder / "server.toml"
        more = "".join(f"{name} = {value}\n" for name, value in limits.items())
        file.write_text(f"{text}\n[limits]\nresume_s = 0\n{more}", "utf-8")
        flags = [] if data is None else ["--data", str(data), "--durability", "process"]
        settings = parse(["--config", str(file), *flags], {})
        assert isinstance(settings, Settings)
        self.settings, self.now = settings, 100.0
        self.host = WorldHost(settings, TerrainPool(), None, at_once, None)  # type: ignore[arg-type]
        kinds = declared_kinds(settings)
        default = Game(load_scene("arena"), limits=settings.limits)
        self.worlds = self.host.worlds = Worlds(kinds, settings.limits, self.host, default=default)
        self.worlds.now = self.now
        self.host.restore(kinds)

    def pass_s(self, seconds: float) -> None:
        """Lets time pass for the worlds, without ticks."""
        self.now += seconds
        self.worlds.tick(self.now)
        self.host.look_after()

    def game(self, name: str) -> Game:
        return self.host.running[name].game

    def tick(self, name: str, times: int = 1) -> None:
        """Runs ticks of a world, as its ticker would."""
        for _ in range(times):
            if name in self.host.running:
                self.host.running[name].ticker._run(self.now, self.now)
                self.now += 1 / 32

    def join(self, target: str, name: str = "") -> tuple[Link, Any, Any]:
        """Lets a client join. Returns its link, what gets its events, and its session."""
        way: Any = self.worlds.route(target)
        assert not isinstance(way, str), way
        link = Link()
        session = way.open(link, self.now)
        way.receive(session, encode(Hello(messages.VERSION, {}, name)), self.now)
        self.tick(target[1:].partition("?")[0])
        return link, way, session

    def files(self) -> list[str]:
        """Returns the names of the saved worlds on disk, after all files are closed."""
        for closing in list(self.host._closing.values()):
            closing.result(10)
        assert self.settings.data is not None
        return sorted(path.name for path in (Path(self.settings.data) / "worlds").iterdir())

    def close(self) -> None:
        self.host.stop()
        self.host.close()


def fake_alarms(monkeypatch: pytest.MonkeyPatch) -> list[Alarm]:
    """Replaces the alarms of tickers. Returns those that are set, now and later."""
    Alarm.all = []
    monkeypatch.setattr(SharedTimer, "alarm", lambda timer, ring: Alarm(ring))
    return Alarm.all
