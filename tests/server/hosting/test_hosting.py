"""The worlds of a server process as a whole: ways, limits of addresses, worlds of the start, draining."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from server.config.options import SettingsError
from server.config.settings import Settings, parse
from server.game import Game
from server.hosting.declared import declared_kinds
from server.hosting.hosting import Hosting
from server.observability.errors import FaultReporter
from server.observability.pages import Page, PageRequest
from server.runtime.tasks import Tasks
from server.runtime.terrain import TerrainPool
from shared.scene import load_scene
from tests.server.hosting.bench import KEEPING, PLAIN, Link

LONG_S = 10.0


class Server:
    """The worlds of a server, without its sockets."""

    def __init__(self, folder: Path, text: str, *flags: str, token: str = "") -> None:
        file = folder / "server.toml"
        file.write_text(text, "utf-8")
        settings = parse(["--config", str(file), *flags], {})
        assert isinstance(settings, Settings)
        self.game = Game(load_scene("arena"), limits=settings.limits)
        self.faults, self.stopped = FaultReporter(), list[str]()
        tasks = Tasks(asyncio.get_running_loop(), 1.0)
        self.hosting = Hosting(
            settings,
            declared_kinds(settings),
            TerrainPool(),
            self.game,
            tasks,
            token=token,
            faults=self.faults,
            stop=self.stopped.append,
        )
        self.hosting.start()

    def route(self, target: str, address: str = "127.0.0.1") -> Any:
        return self.hosting.route(target, address)

    async def until_stopped(self) -> str:
        async with asyncio.timeout(LONG_S):
            while not self.stopped:  # noqa: ASYNC110 - a function is called, no event is set
                await asyncio.sleep(0.005)
        return self.stopped[0]

    def close(self) -> None:
        self.hosting.shut_down("over", 1.0)
        self.hosting.host.close()
        assert not self.faults.total


def refused(found: object) -> tuple[int, str]:
    assert isinstance(found, Page)
    return found.status, found.body.decode().strip()


async def test_paths_lead_to_worlds_to_the_lobby_or_nowhere(tmp_path: Path) -> None:
    server = Server(tmp_path, PLAIN + "start = 2\n")
    assert server.route("/") is server.game
    assert [*server.hosting.worlds.worlds] == ["plain", "plain-2"]
    assert not isinstance(server.route("/plain-2"), Page)
    assert not isinstance(server.route("/match?kind=plain"), Page)
    assert refused(server.route("/nowhere")) == (404, "there is no world 'nowhere'")
    assert refused(server.route("/plain?seat=forged")) == (404, "this is no seat of this server")
    assert refused(server.route("/match?seats=0"))[0] == 404
    server.close()


async def test_requests_of_an_address_are_limited_but_not_those_of_this_machine(tmp_path: Path) -> None:
    server = Server(tmp_path, PLAIN + "[limits]\nasks_per_s = 0.01\n")
    for address in ("1.2.3.4", "2001:db8::1"):
        assert not isinstance(server.route("/match?kind=plain", address), Page)
        assert refused(server.route("/match?kind=plain", address))[0] == 429
    assert refused(server.route("/match?kind=plain", "2001:db8::2"))[0] == 429, "one customer has a whole network"
    assert not isinstance(server.route("/match?kind=plain", "1.2.3.5"), Page)
    for _ in range(50):
        assert not isinstance(server.route("/match?kind=plain"), Page)
    server.close()


async def test_worlds_of_the_start_stay_and_come_back_with_their_data(tmp_path: Path) -> None:
    text, data = KEEPING + "start = 1\n", ["--data", str(tmp_path / "data"), "--durability", "process"]
    server = Server(tmp_path, text.replace("empty_s = 5", "empty_s = 0"), *data)
    server.hosting.host.running["keeping"].game.world.set_block(3, 3, 0, 4)
    state = server.hosting.host.running["keeping"].game.world.state_hash()
    server.hosting.worlds.tick(server.hosting.worlds.now + 100)
    assert [*server.hosting.worlds.worlds] == ["keeping"]
    server.close()
    again = Server(tmp_path, text, *data)
    assert [*again.hosting.worlds.worlds] == ["keeping"]
    assert again.hosting.host.running["keeping"].game.world.state_hash() == state
    again.close()


async def test_a_server_drains_until_nobody_is_in_a_world(tmp_path: Path) -> None:
    server = Server(tmp_path, PLAIN, "--drain-s", "1000")
    world = server.hosting.worlds.create("plain", name="a")
    way, link = server.route("/a"), Link()
    session = way.open(link, 0.0)
    server.hosting.drain()
    for target in ("/match?kind=plain", "/create?kind=plain"):
        assert refused(server.route(target)) == (503, "the server is about to stop")
    assert not isinstance(server.route("/a"), Page), "a world goes on, and lets players in"
    assert not world.empty
    await asyncio.sleep(0.25)
    assert not server.stopped
    way.lost(session, 0.0)
    assert await server.until_stopped() == "drained"
    server.close()


async def test_a_server_drains_no_longer_than_it_may(tmp_path: Path) -> None:
    server = Server(tmp_path, PLAIN)
    server.hosting.worlds.create("plain", name="a")
    server.route("/a").open(Link(), 0.0)
    server.hosting.drain(0.01)
    assert await server.until_stopped() == "drained, with players in 1 worlds"
    server.close()


async def test_operators_come_before_pages(tmp_path: Path) -> None:
    server = Server(tmp_path, PLAIN, token="a-token-of-operators")

    def ask(method: str, path: str, query: str = "", authorization: str = "") -> int | None:
        page = server.hosting.page(PageRequest(method, path, query, True, authorization))
        return None if page is None else page.status

    assert ask("POST", "/worlds", "kind=plain&name=a") == 401
    assert ask("POST", "/worlds", "kind=plain&name=a", "Bearer a-token-of-operators") == 200
    assert ask("GET", "/worlds", "all=1") == 401
    assert ask("GET", "/worlds") == ask("GET", "/a/stats") == ask("GET", "/worlds/") == 200
    assert ask("HEAD", "/worlds") is None
    assert ask("GET", "/stats") is None
    server.close()


async def test_a_failure_in_looking_after_the_worlds_is_counted_and_they_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = Server(tmp_path, PLAIN)
    tick, calls = server.hosting.worlds.tick, list[float]()

    def fails_once(now: float) -> None:
        calls.append(now)
        if len(calls) == 1:
            raise ZeroDivisionError
        tick(now)

    monkeypatch.setattr(server.hosting.worlds, "tick", fails_once)
    async with asyncio.timeout(LONG_S):
        while len(calls) < 3:  # noqa: ASYNC110 - a timer calls it
            await asyncio.sleep(0.005)
    assert server.faults.total == 1
    server.faults.total = 0
    server.close()


async def test_a_data_directory_that_cannot_be_used_is_an_error_of_the_settings(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("in the way")
    with pytest.raises(SettingsError, match=r"data = .*: cannot be used"):
        Server(tmp_path, PLAIN, "--data", str(tmp_path / "data"))
