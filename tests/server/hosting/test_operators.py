"""The requests of operators, and the command that sends them."""

import json
import random
from pathlib import Path
from typing import Any

import pytest

from server.auth.access import operator_token
from server.config.options import SettingsError
from server.hosting import command
from server.hosting.operators import Operators
from server.observability.pages import Page, PageRequest
from shared import messages
from tests.server.hosting.bench import PLAIN, Bench

pytestmark = pytest.mark.usefixtures("alarms")

TOKEN = "t0ken-of-operators"


class Office(Bench):
    """Worlds with requests of operators."""

    def __init__(self, folder: Path, token: str = TOKEN) -> None:
        super().__init__(folder, PLAIN, worlds_max=3)
        self.drains: list[float | None] = []
        self.operators = Operators(self.worlds, self.host, token, self.drains.append)

    def ask(self, method: str, target: str, authorization: str = f"Bearer {TOKEN}") -> Page | None:
        path, _, query = target.partition("?")
        return self.operators.get(PageRequest(method, path, query, False, authorization))

    def done(self, method: str, target: str) -> Any:
        """Sends a request that is carried out. Returns the answer."""
        page = self.ask(method, target)
        assert page is not None
        assert page.status == 200, page
        return json.loads(page.body)

    def refused(self, method: str, target: str, **options: str) -> tuple[int, str]:
        """Sends a request that is refused. Returns status and text."""
        page = self.ask(method, target, **options)
        assert page is not None
        assert page.status >= 400, page
        return page.status, page.body.decode().strip()


@pytest.fixture
def office(tmp_path: Path) -> Office:
    return Office(tmp_path)


def test_an_operator_makes_lists_and_ends_worlds(office: Office) -> None:
    assert office.done("POST", "/worlds?kind=plain&mode=2v2&name=a") == {"name": "a", "code": "", "path": "/a"}
    made = office.done("POST", "/worlds?kind=plain&private=1")
    assert (made["name"], len(made["code"])) == ("plain-1", 6)
    link, *_ = office.join("/a", "Ann")
    listed = office.done("GET", "/worlds?all=1")
    assert [(world["name"], world["code"], world["who"]) for world in listed["worlds"]] == [
        ("a", "", {"1": "Ann"}),
        ("plain-1", made["code"], {}),
    ]
    assert listed["worlds"][0]["properties"] == {"mode": "2v2"}
    assert listed["asleep"] == []
    assert office.done("DELETE", "/worlds/a?reason=an%20update") == {"name": "a"}
    assert (link.bye.code, link.bye.reason) == (messages.ENDED, "an update")
    assert [*office.worlds.worlds] == ["plain-1"]


def test_an_operator_removes_a_player_in_the_next_tick(office: Office) -> None:
    office.worlds.create("plain", name="a")
    link, _, session = office.join("/a", "Ann")
    other, *_ = office.join("/a", "Ben")
    assert office.done("POST", f"/worlds/a/kick?player={session.entity}&reason=rude") == {"name": "a", "player": "Ann"}
    assert not link.closings
    office.tick("a")
    assert (link.bye.code, link.bye.reason) == (messages.KICKED, "rude")
    office.tick("a")
    assert not other.closings
    assert [player.name for player in office.game("a").players.values()] == ["Ben"]


def test_an_operator_drains_the_server(office: Office) -> None:
    assert office.done("POST", "/drain") == {"worlds": 0}
    assert office.done("POST", "/drain?within_s=2.5") == {"worlds": 0}
    assert office.drains == [None, 2.5]


@pytest.mark.parametrize(
    ("method", "target", "status", "text"),
    [
        ("POST", "/worlds?kind=x", 409, "kind = 'x': there is no such kind; there are plain"),
        ("POST", "/worlds?kind=plain&name=a", 409, "name = 'a': there is a world of that name"),
        ("POST", "/worlds?kind=plain&name=A", 409, "name = 'A': must be 1 to 32 small letters"),
        ("POST", "/worlds?kind=plain&name=stats", 409, "name = 'stats': is a path of the server"),
        ("POST", "/worlds?kind=plain&name=..%2Fa", 409, "name = '../a': must be 1 to 32 small letters"),
        ("POST", "/worlds?kind=plain&x=" + "y" * 65, 409, "property x = "),
        ("POST", "/worlds?" + "&".join(f"p{n}=1" for n in range(30)), 400, "query: "),
        ("POST", "/worlds?kind=plain&" + "&".join(f"p{n}=1" for n in range(20)), 409, "20 properties: at most 16"),
        ("DELETE", "/worlds/b", 409, "there is no world 'b'"),
        ("DELETE", "/worlds/" + "b" * 5000, 409, "there is no world 'bbbbbb"),
        ("DELETE", "/worlds/a?reason=" + "r" * 501, 409, "reason: longer than 500 characters"),
        ("DELETE", "/worlds", 404, "DELETE /worlds: no such request"),
        ("POST", "/worlds/a", 404, "POST /worlds/a: no such request"),
        ("POST", "/worlds/a/kick", 409, "player = '': is no player of the world a; give the entity's number"),
        ("POST", "/worlds/a/kick?player=99", 409, "player = '99': is no player of the world a"),
        ("POST", "/worlds/a/kick?player=%D9%A3", 409, "player = '\u0663': is no player of the world a"),
        ("POST", "/worlds/a/kick?player=" + "9" * 5000, 409, "player = '999"),
        ("POST", "/worlds/b/kick?player=1", 409, "there is no world 'b'"),
        ("POST", "/drain?within_s=x", 409, "within_s = 'x': must be a number from 0 to 86400"),
        ("POST", "/drain?within_s=nan", 409, "within_s = 'nan': must be a number from 0 to 86400"),
        ("POST", "/drain?within_s=-1", 409, "within_s = '-1': must be a number from 0 to 86400"),
    ],
)
def test_a_request_that_cannot_be_carried_out_gets_the_reason_and_changes_nothing(
    office: Office, method: str, target: str, status: int, text: str
) -> None:
    office.worlds.create("plain", name="a")
    found, reason = office.refused(method, target)
    assert (found, reason[: len(text)]) == (status, text)
    assert ([*office.worlds.worlds], office.drains) == (["a"], [])


def test_worlds_have_a_limit_for_operators_too(office: Office) -> None:
    for _ in range(3):
        office.done("POST", "/worlds?kind=plain")
    assert office.refused("POST", "/worlds?kind=plain")[0] == 409


WRONG = ("", "Bearer", "Bearer ", TOKEN, f"bearer {TOKEN}", f"Bearer {TOKEN} ", f"Bearer {TOKEN[:-1]}", "Bearer \udcff")


@pytest.mark.parametrize("authorization", WRONG)
def test_without_the_token_nothing_happens(office: Office, authorization: str) -> None:
    office.worlds.create("plain", name="a")
    for method, target in (
        ("GET", "/worlds?all=1"), ("POST", "/worlds?kind=plain"), ("DELETE", "/worlds/a"), ("POST", "/drain"),
        ("POST", "/worlds/a/kick?player=1"),
    ):  # fmt: skip
        status, text = office.refused(method, target, authorization=authorization)
        assert (status, text) == (401, "this needs the token of operators")
        assert TOKEN not in text
    assert ([*office.worlds.worlds], office.drains) == (["a"], [])


def test_a_server_without_a_token_has_no_operators(tmp_path: Path) -> None:
    office = Office(tmp_path, token="")
    assert office.refused("POST", "/worlds?kind=plain")[0] == 403
    assert office.refused("POST", "/worlds?kind=plain", authorization="Bearer ")[0] == 403
    assert not office.worlds.worlds


def test_other_requests_are_not_answered_here(office: Office) -> None:
    for method, target in (
        ("GET", "/worlds"), ("GET", "/worlds?kind=all=1"), ("GET", "/"), ("GET", "/drain"), ("HEAD", "/worlds"),
        ("POST", "/stats"), ("PUT", "/worlds/a"), ("OPTIONS", "/worlds"),
    ):  # fmt: skip
        assert office.ask(method, target) is None


def test_random_requests_are_answered_or_left(office: Office) -> None:
    r = random.Random(1)
    parts = ["worlds", "a", "kick", "drain", "", "..", "%00", "?", "&", "=", "kind=plain", "name=", "all=1", "\u00e4"]
    for _ in range(2000):
        target = "/" + "".join(r.choice(["/", ""]) + r.choice(parts) for _ in range(r.randrange(6)))
        page = office.ask(r.choice(["GET", "POST", "DELETE"]), target)
        assert page is None or page.status in (200, 400, 404, 409)


# -- the token and the command -------------------------------------------------------------------------------


def test_the_token_comes_from_a_file_or_the_environment(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(f"  {TOKEN}\n")
    assert operator_token(str(file), {"SOVEREIGN_OPERATOR_TOKEN": "x" * 20}) == TOKEN
    assert operator_token(None, {"SOVEREIGN_OPERATOR_TOKEN": TOKEN}) == TOKEN
    assert operator_token(None, {}) == ""
    for bad in (b"short", b"", b"with a space in it", b"\xff" * 20, "umlauts \u00e4 umlauts".encode()):
        file.write_bytes(bad)
        with pytest.raises(SettingsError, match="operator_token_file = ") as error:
            operator_token(str(file), {})
        assert not bad or bad.decode(errors="replace") not in str(error.value)
    with pytest.raises(SettingsError, match="No such file"):
        operator_token(str(tmp_path / "none"), {})


@pytest.mark.parametrize(
    ("arguments", "request_"),
    [
        (["list"], ("GET", "/worlds", {"all": "1"})),
        (["create", "duel"], ("POST", "/worlds", {"kind": "duel", "name": "", "private": "0"})),
        (
            ["create", "duel", "mode=2v2", "x=", "--private", "--name", "a"],
            ("POST", "/worlds", {"kind": "duel", "name": "a", "private": "1", "mode": "2v2", "x": ""}),
        ),
        (["end", "a/b", "--reason", "over"], ("DELETE", "/worlds/a%2Fb", {"reason": "over"})),
        (["kick", "a", "7"], ("POST", "/worlds/a/kick", {"player": "7"})),
        (["kick", "a", "7", "--reason", "rude"], ("POST", "/worlds/a/kick", {"player": "7", "reason": "rude"})),
        (["drain"], ("POST", "/drain", {})),
        (["drain", "--within-s", "9"], ("POST", "/drain", {"within_s": "9"})),
    ],
)
def test_the_command_makes_one_request(arguments: list[str], request_: tuple[str, str, dict[str, str]]) -> None:
    asked = command._parsed(arguments, {})
    assert asked["url"] == "http://127.0.0.1:8765"
    assert command._request(asked) == request_


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["create", "duel", "mode"], "property 'mode': must be NAME=VALUE"),
        (["create", "duel", "kind=x"], "property 'kind=x': must be NAME=VALUE, with a name of its own"),
        (["list", "--url", "localhost:1"], "url = 'localhost:1': must be like http://HOST:PORT"),
        (["list", "--url", "http://host/page"], "url = 'http://host/page': must be like http://HOST:PORT"),
        (["destroy"], "argument list|create|end|kick|drain: invalid choice: 'destroy'"),
        (["list", "--all"], "unrecognized arguments: --all"),
        ([], "the following arguments are required: list|create|end|kick|drain"),
    ],
)
def test_the_command_names_what_is_wrong(arguments: list[str], message: str) -> None:
    with pytest.raises(SettingsError) as error:
        command.main(arguments, {"SOVEREIGN_OPERATOR_TOKEN": TOKEN})
    assert message in str(error.value)


def test_the_command_needs_a_token() -> None:
    with pytest.raises(SettingsError, match="there is no token of operators; set operator_token_file or"):
        command.main(["list"], {})


def test_the_command_reports_a_server_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    environment = {"SOVEREIGN_OPERATOR_TOKEN": TOKEN}
    assert command.main(["list", "--url", "ws://127.0.0.1:1"], environment) == 1
    assert capsys.readouterr().out.startswith("error: no answer from ws://127.0.0.1:1 (")
