"""Text that UTF-8 cannot encode (a lone surrogate) is refused everywhere, by name, and leaves nothing behind."""

import asyncio
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jwt
import pytest

from client_sdk import AsyncClient, Client, Loopback
from client_sdk.core import Core
from server.agents import Arena
from server.auth import access, tokens
from server.auth.identity import AuthError
from server.config.options import SettingsError
from server.config.settings import Settings, load
from server.game import Game
from server.game_api.api import GameApi
from server.persistence.store import Store
from server.rules import Rules
from shared import messages
from shared.checks import SceneError
from shared.messages import Hello, Welcome
from shared.scene import Scene, Template, load_scene
from tests.server.test_persisted_state import Stored
from tests.server.test_store import SCENE
from tests.tables import Table

BAD = ["\ud800", "Ann\udfff", "\udc80"]
"""Lone surrogates: a high one, a low one, and the one that stands for a byte of the command line that is not UTF-8."""
KEY, NOW = b"k" * 32, 1_800_000_000.0


def token(subject: str) -> str:
    """Returns a token signed with the right key. JSON can contain text that UTF-8 cannot encode."""
    return jwt.PyJWS().encode(json.dumps({"sub": subject, "exp": NOW + 60}).encode(), KEY, "HS256")


def wanted(bad: str, field: str) -> str:
    """Returns a pattern for the beginning of an error about a text."""
    return rf"^{field} = .*{ascii(bad)[1:-1]}.*UTF-8".replace("\\u", "\\\\u")


@pytest.mark.parametrize("bad", BAD)
def test_the_subject_of_a_token(bad: str) -> None:
    with pytest.raises(AuthError, match=r"the token's subject '.*\\u.*' cannot be encoded in UTF-8"):
        tokens.Tokens(KEY, lambda: NOW)(token(bad))
    with pytest.raises(SceneError, match=wanted(bad, "subject")):
        tokens.issue(KEY, bad, 60, NOW)
    with pytest.raises(SettingsError, match=wanted(bad, "subject")):
        tokens.main(["--subject", bad], {"SOVEREIGN_AUTH_KEY": "k" * 32})


def test_a_key_of_any_bytes_is_one() -> None:
    assert tokens.read_key(None, {"SOVEREIGN_AUTH_KEY": "k" * 31 + "\udcff"}) == b"k" * 31 + b"\xff"


@pytest.mark.parametrize("bad", [*BAD, None, 7, b"ann", "a" * 65, ["ann"]])
def test_the_subject_that_a_games_own_check_returns(bad: Any) -> None:
    table = Table()
    table.game.joining.authenticate = lambda token: bad
    code, reason = table.connect(Hello(messages.VERSION, {}, "Ann", "x")).refusal()
    assert (code, reason) == (messages.UNAUTHORISED, "the server's authenticator returned no valid subject")
    assert table.game.faults.total == 1
    table.tick()
    assert (table.game.players, len(table.game.world), table.game.sessions[1:]) == ({}, 0, [])


def test_a_games_own_check_that_fails_costs_its_client_alone() -> None:
    table = Table()
    table.game.joining.authenticate = lambda token: {"ann": "Ann"}[token]
    bad, good = (table.connect(Hello(messages.VERSION, {}, "", said)) for said in ("bob", "ann"))
    table.tick()
    assert bad.closings == [(messages.INTERNAL, "internal error")]
    assert [player.subject for player in table.game.players.values()] == ["Ann"]
    assert good.got(Welcome)


@pytest.mark.parametrize("bad", BAD)
def test_the_reason_of_a_refusal_is_sent_as_far_as_utf8_allows(bad: str) -> None:
    def check(token: str) -> str:
        raise AuthError(f"{bad} is not known")

    table = Table()
    table.game.joining.authenticate = check
    code, reason = table.connect(Hello(messages.VERSION, {}, "Ann", "x")).refusal()
    assert (code, reason) == (messages.UNAUTHORISED, f"{bad.encode(errors='replace').decode()} is not known")


class Waits:
    async def __call__(self, token: str) -> str:
        return token


async def waits(token: str) -> str:
    return token


waiting = Waits()


@pytest.mark.parametrize(("name", "why"), [("waits", "async"), ("waiting", "async"), ("Waits", "is a class")])
def test_a_check_that_can_never_answer_is_named_at_the_start(name: str, why: str) -> None:
    with pytest.raises(SettingsError, match=f"auth = '{__name__}:{name}': .*{why}"):
        access.authenticator(Settings(auth=f"{__name__}:{name}"))


@pytest.mark.parametrize("bad", [*BAD, None, 7, b"Ann"])
def test_names_and_tokens_of_clients(bad: Any) -> None:
    def joining(**given: Any) -> list[Callable[[], Any]]:
        url = "ws://127.0.0.1:1"
        return [
            lambda: Core(**given),
            lambda: Client.connect(url, **given),
            lambda: asyncio.run(AsyncClient.connect(url, **given)),
            lambda: Loopback(Game(load_scene("flat"), compiled=False)).join(**given),
        ]

    for field in ("name", "token"):
        for join in joining(**{field: bad}):
            with pytest.raises(ValueError, match=f"^{field} = .*: must be a text"):
                join()


@pytest.mark.parametrize("bad", BAD)
def test_texts_in_commands_of_a_client(bad: str) -> None:
    loopback = Loopback(Game(load_scene("flat"), compiled=False))
    client = loopback.join("Ann")
    frame = 0
    while not client.playing:
        frame += 1
        client.poll(frame / 60)
        client.update(frame / 60)
    with pytest.raises(ValueError, match=wanted(bad, "name")):
        client.command(bad)
    for data in (bad, [bad], {"a": {bad: 1}}):
        with pytest.raises(ValueError, match=r"^say: data = .*UTF-8"):
            client.command("say", data)
    assert client.command("say", "é\U0001f600") == 1  # no number was used up


def acts(game: GameApi, bad: str) -> list[Callable[[], Any]]:
    """Returns all calls by which rules can send or store a text."""
    return [
        lambda: game.set(1, bad, 1),
        lambda: game.set(1, "mood", bad),
        lambda: game.set(1, "mood", [{"a": bad}]),
        lambda: game.set(1, "mood", {bad: 1}),
        lambda: game.share(bad, 1),
        lambda: game.share("score", ["x", bad]),
        lambda: game.send(bad),
        lambda: game.send("boom", bad),
        lambda: game.send("boom", {bad: None}),
        lambda: game.spawn("stone", (8, 8, 1), **{bad: 1}),  # type: ignore[arg-type]
        lambda: game.spawn("stone", (8, 8, 1), mood=bad),
    ]


@pytest.mark.parametrize("bad", BAD)
def test_texts_of_the_rules(tmp_path: Path, bad: str) -> None:
    table = Stored(tmp_path)
    link = table.join()
    game = table.game.api
    game.share("score", 1)
    table.tick()
    before = (dict(game.shared), dict(game.kept.attributes), len(table.game.world), len(link.sent))
    for act in acts(game, bad):
        with pytest.raises(SceneError, match="UTF-8"):
            act()
    table.store._copy_due = True
    table.tick()
    assert (dict(game.shared), dict(game.kept.attributes), len(table.game.world)) == before[:3]
    assert [type(message).__name__ for message in link.sent[before[3] :]] == ["Snapshot"]
    table.stop()
    again = Stored(tmp_path)
    assert again.game.api.shared == {"score": 1}
    again.stop()


@pytest.mark.parametrize("bad", BAD)
def test_scenes_settings_and_stores(bad: str, tmp_path: Path) -> None:
    flat = load_scene("flat")
    for make, field in (
        (lambda: replace(flat, name=bad), "name"),
        (lambda: replace(flat, player=bad), "player"),
        (lambda: replace(flat, integrator=bad), "integrator"),
        (lambda: replace(flat, terrain={"generator": "flat", bad: 1}), "terrain: the name of a parameter"),
        (lambda: replace(flat, terrain={"generator": "flat", "x": [bad]}), "terrain.x"),
        (lambda: Template(bad), "templates.name"),
        (lambda: Template("a", shown=bad), "templates.a.shown"),
        (lambda: flat.with_template(bad), "templates.name"),
        (lambda: flat.with_template("b", like=bad), "like"),
        (lambda: Scene.from_table({"name": bad}), "name"),
        (lambda: Store(tmp_path, SCENE, game=bad), "game"),
    ):
        with pytest.raises(SceneError, match=rf"^{field} = .*\\u"):
            make()
    for name in ("host", "data", "game", "auth", "scene", "allowed_origins"):
        with pytest.raises(SettingsError, match=rf"^{name} = .*\\u.* \(from --{name.replace('_', '-')}\): .*UTF-8"):
            load({name: bad}, {})
    assert list(tmp_path.iterdir()) == []


def test_agents_ask_with_text_as_well() -> None:
    env = Arena("flat", agents=1, rules=Rules, compiled=False)
    env.reset(seed=1)
    with pytest.raises(ValueError, match=wanted("\ud800", "name")):
        env.command("player_0", "\ud800")
