"""The command `sovereign-server worlds`: lists, makes and ends the worlds of a running server, over HTTP."""

import http.client
import json
import os
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping, Sequence
from typing import Any

from server.auth.access import operator_token
from server.config.options import Parser, SettingsError

TIME_OUT_S = 10.0
"""Seconds that the command waits for an answer."""
ANSWER_MAX = 64 << 20
"""Maximum length of an answer, in bytes."""


def main(arguments: Sequence[str], environment: Mapping[str, str] = os.environ) -> int:
    """Runs `sovereign-server worlds`: sends one request to a server and prints the answer.

    Returns:
        The exit code: 0 if the server has done it, otherwise 1.

    Raises:
        SettingsError: an argument or the token cannot be used.
    """
    asked = _parsed(arguments, environment)
    token = operator_token(asked["operator_token_file"], environment)
    if not token:
        raise SettingsError("there is no token of operators; set operator_token_file or SOVEREIGN_OPERATOR_TOKEN")
    method, path, fields = _request(asked)
    url = f"{_base(asked['url'])}{path}?{urllib.parse.urlencode(fields)}"
    headers = {"Authorization": f"Bearer {token}"}
    # No proxy, and no redirect: the token is for this server alone.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), _NoRedirect())
    try:
        with opener.open(urllib.request.Request(url, headers=headers, method=method), timeout=TIME_OUT_S) as answer:
            _print(asked, json.loads(answer.read(ANSWER_MAX)))
        return 0
    except urllib.error.HTTPError as error:
        with error:
            print(f"error: {error.read(1000).decode(errors='replace').strip() or error.code}")
    except (OSError, ValueError, http.client.HTTPException) as error:
        print(f"error: no answer from {asked['url']} ({getattr(error, 'reason', None) or error})")
    return 1


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any) -> None:
        return None


def _parsed(arguments: Sequence[str], environment: Mapping[str, str]) -> dict[str, Any]:
    """Parses the command line."""
    parser = Parser(
        prog="sovereign-server worlds", description="Operates the worlds of a running server.", allow_abbrev=False
    )
    port = environment.get("SOVEREIGN_PORT", "8765")
    url = f"http://127.0.0.1:{port}"
    commands = parser.add_subparsers(dest="command", required=True, metavar="list|create|end|kick|drain")
    made = {
        "list": "print all worlds, with codes and players",
        "create": "make a world and print its name and code",
        "end": "end a world and remove its data",
        "kick": "remove a player from a world",
        "drain": "let worlds go on to their end, then stop the server",
    }
    for name, text in made.items():
        one = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.", allow_abbrev=False)
        one.add_argument("--url", default=url, help=f"address of the server (default: {url})")
        one.add_argument(
            "--operator-token-file",
            default=environment.get("SOVEREIGN_OPERATOR_TOKEN_FILE"),
            metavar="FILE",
            help="file with the token; alternatively the token itself in SOVEREIGN_OPERATOR_TOKEN",
        )
        if name == "create":
            one.add_argument("kind", metavar="KIND", help="kind of the world")
            one.add_argument("--name", default="", help="name of the world (default: KIND-1, KIND-2, ...)")
            one.add_argument("--private", action="store_true", help="let only those with the code or a seat in")
            one.add_argument("properties", nargs="*", metavar="NAME=VALUE", help="properties of the world")
        if name in ("end", "kick"):
            one.add_argument("world", metavar="WORLD", help="name of the world")
            one.add_argument("--reason", default="", help="reason, which the players get")
        if name == "kick":
            one.add_argument("player", metavar="PLAYER", help="number of the player's entity, as in the list")
        if name == "drain":
            one.add_argument("--within-s", metavar="S", help="maximum time in seconds (default: drain_s of the server)")
    return parser.flags(arguments)


def _request(asked: dict[str, Any]) -> tuple[str, str, dict[str, str]]:
    """Returns method, path and query of the request.

    Raises:
        SettingsError: a property is not NAME=VALUE.
    """
    match asked["command"]:
        case "list":
            return "GET", "/worlds", {"all": "1"}
        case "create":
            fields = {"kind": asked["kind"], "name": asked["name"], "private": str(int(asked["private"]))}
            for text in asked["properties"]:
                name, equals, value = text.partition("=")
                if not name or not equals or name in fields:
                    raise SettingsError(f"property {text!r}: must be NAME=VALUE, with a name of its own")
                fields[name] = value
            return "POST", "/worlds", fields
        case "drain":
            return "POST", "/drain", {} if asked["within_s"] is None else {"within_s": asked["within_s"]}
    world = urllib.parse.quote(asked["world"], safe="")
    reason = {"reason": asked["reason"]} if asked["reason"] else {}
    if asked["command"] == "end":
        return "DELETE", f"/worlds/{world}", reason
    return "POST", f"/worlds/{world}/kick", {"player": asked["player"], **reason}


def _base(url: str) -> str:
    """Returns the address of a server as the beginning of a URL for HTTP.

    Raises:
        SettingsError: it is none.
    """
    scheme, _, rest = url.partition("://")
    host = rest.rstrip("/")
    known = {"http": "http", "https": "https", "ws": "http", "wss": "https"}
    if scheme not in known or not host or "/" in host:
        raise SettingsError(f"url = {url!r}: must be like http://HOST:PORT or https://HOST:PORT")
    return f"{known[scheme]}://{host}"


def _print(asked: dict[str, Any], answer: dict[str, Any]) -> None:
    match asked["command"]:
        case "list":
            for world in answer["worlds"]:
                state = [f"code {world['code']}" if world["code"] else "", "locked" if world["locked"] else ""]
                state += ["" if world["ticking"] else "rests"]
                state += [f"{name}={value}" for name, value in world["properties"].items()]
                state += [f"{entity}: {name}" for entity, name in world["who"].items()]
                players = f"{world['players']}/{world['players_max']}"
                print(
                    f"{world['name']:<16} {world['kind']:<12} {players:>7}  {', '.join(filter(None, state))}".rstrip()
                )
            for name in answer["asleep"]:
                print(f"{name:<16} asleep")
        case "create":
            print(answer["name"], answer["code"])
        case "drain":
            print(f"draining: {answer['worlds']} worlds")
        case _:
            print(json.dumps(answer))
