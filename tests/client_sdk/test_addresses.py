"""The addresses of worlds that the calls of a program make, and the errors of wrong arguments."""

from typing import Any

import pytest

from client_sdk import AsyncClient, Client
from client_sdk.addresses import at, creating, joining, matching, options_of


@pytest.mark.parametrize(
    ("path", "made"),
    [
        (matching("arena", 1, {}), "/match?kind=arena"),
        (matching("arena", 2, {"mode": "2v2"}), "/match?kind=arena&mode=2v2&seats=2"),
        (matching("arena", 1, {"a": True, "b": False, "c": -3}), "/match?kind=arena&a=true&b=false&c=-3"),
        (matching("a b&c", 1, {"ä": "1=2&kind=x"}), "/match?kind=a+b%26c&%C3%A4=1%3D2%26kind%3Dx"),
        (creating("arena", False, {"map": ""}), "/create?kind=arena&map="),
        (creating("arena", True, {}), "/create?kind=arena&private=1"),
        (joining("K7 ?&", "", ""), "/join?code=K7+%3F%26"),
        (joining("", "/arena-1?seat=a.b", ""), "/arena-1?seat=a.b"),
        (joining("", "", "arena-1"), "/arena-1"),
    ],
)
def test_paths(path: str, made: str) -> None:
    assert path == made


def test_addresses() -> None:
    for url in ("ws://localhost:8765", "ws://localhost:8765/", "ws://localhost:8765/old?seat=1"):
        assert at(url, "/match?kind=arena") == "ws://localhost:8765/match?kind=arena"
    assert at("wss://ann:x@[::1]:1", "/") == "wss://ann:x@[::1]:1/"
    for wrong in ("localhost:8765", "", "ws://[::1", 5, None):  # the connection raises the error
        assert at(wrong, "/") == wrong  # type: ignore[arg-type]


@pytest.mark.parametrize("client", [Client, AsyncClient])
def test_arguments_of_connect_are_no_properties(client: Any) -> None:
    given = {"name": "Ann", "mode": "2v2", "patience_s": 3.0, "link": None}
    assert options_of(client.connect, given) == {"name": "Ann", "patience_s": 3.0, "link": None}
    assert given == {"mode": "2v2"}


@pytest.mark.parametrize(
    ("how", "wrong", "why"),
    [
        ("match", {"kind": ""}, "kind = ''"),
        ("match", {"kind": 3}, "kind = 3"),
        ("match", {"kind": "k" * 33}, "kind ="),
        ("match", {"kind": "\ud800"}, "UTF-8"),
        ("match", {"kind": "a", "seats": 0}, "seats = 0"),
        ("match", {"kind": "a", "seats": 65}, "seats = 65"),
        ("match", {"kind": "a", "seats": "2"}, "seats = '2'"),
        ("match", {"kind": "a", "private": True}, "private = True: this name cannot be a property"),
        ("match", {"kind": "a", "code": "x"}, "code = 'x': this name cannot be a property"),
        ("match", {"kind": "a", "level": 1.5}, "level = 1.5: a property must be"),
        ("match", {"kind": "a", "level": None}, "level = None: a property must be"),
        ("match", {"kind": "a", "level": 1 << 53}, "level = "),
        ("match", {"kind": "a", "mode": "m" * 65}, "mode = "),
        ("match", {"kind": "a", "mode": "\ud800"}, "mode = .*UTF-8"),
        ("match", {"kind": "a", "n" * 65: 1}, "this name cannot be a property"),
        ("match", {"kind": "a", **{f"p{i}": "ä" * 64 for i in range(16)}}, "at most 1024"),
        ("create", {"kind": "a", "private": 1}, "private = 1"),
        ("create", {"kind": "a", "seats": 2}, "seats = 2: this name cannot be a property"),
        ("join", {}, "no argument: must be exactly one of code, seat and world"),
        ("join", {"code": "a", "world": "b"}, "code, world: must be exactly one"),
        ("join", {"code": "c" * 17}, "code = "),
        ("join", {"code": 5}, "code = 5"),
        ("join", {"seat": "arena-1?seat=x"}, "seat = 'arena-1"),
        ("join", {"seat": "ws://else/x"}, "seat = 'ws"),
        ("join", {"seat": "/a b"}, "seat = "),
        ("join", {"world": "a/b"}, "world = 'a/b'"),
        ("join", {"world": "a?b"}, "world = "),
        ("join", {"world": "a b"}, "world = "),
        ("join", {"world": 7}, "world = 7"),
    ],
)
def test_wrong_arguments(how: str, wrong: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        getattr(Client, how)("ws://127.0.0.1:1", **wrong)


def test_join_has_no_properties() -> None:
    with pytest.raises(TypeError, match="mode"):
        Client.join("ws://127.0.0.1:1", world="arena-1", mode="2v2")
