"""The requests of operators, which need a token: they make and end worlds, remove players, and drain the server.

    GET     /worlds?all=1                           all worlds with codes and players, and those that sleep
    POST    /worlds?kind=KIND&private=1&name=NAME&PROPERTY=VALUE    make a world
    DELETE  /worlds/NAME?reason=TEXT                end a world and remove its data
    POST    /worlds/NAME/kick?player=ENTITY&reason=TEXT             remove a player
    POST    /drain?within_s=SECONDS                 let worlds go on to their end, then stop

A request has the header `Authorization: Bearer TOKEN` and no body.
"""

import hmac
from collections.abc import Callable
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qsl

from server.hosting.host import WorldHost
from server.hosting.pages import json_answer
from server.observability.pages import Page, PageRequest, line
from server.worlds.kinds import WorldsError
from server.worlds.worlds import Worlds
from shared.fields import REASON_MAX

FIELDS_MAX = 24
"""Maximum number of fields of a query."""
DRAIN_MAX_S = 24 * 3600.0
"""Maximum time of draining, in seconds."""
REASON = "an operator has ended the world"
"""Reason for which a world ends if the operator gives none."""


class OperatorError(ValueError):
    """A request that cannot be carried out. The text is the reason."""


class Operators:
    """The requests of operators.

    Args:
        worlds: the worlds.
        host: their host.
        token: the token; empty: there are no such requests.
        drain: begins to drain; gets the time in seconds, None: the time in the settings.
    """

    def __init__(self, worlds: Worlds, host: WorldHost, token: str, drain: Callable[[float | None], None]) -> None:
        self._worlds, self._host, self._token, self._drain = worlds, host, token.encode(), drain

    def get(self, request: PageRequest) -> Page | None:
        """Returns the answer to a request; None: it is not one of an operator."""
        method, path = request.method, request.path
        listing = method == "GET" and path == "/worlds" and "all=1" in request.query.split("&")
        if not listing and (method not in ("POST", "DELETE") or not path.startswith(("/worlds", "/drain"))):
            return None
        if not self._token:
            return line(HTTPStatus.FORBIDDEN, "the server has no token of operators; see operator_token_file")
        given = request.authorization.encode(errors="replace")
        if not hmac.compare_digest(given, b"Bearer " + self._token):
            return line(HTTPStatus.UNAUTHORIZED, "this needs the token of operators", www_authenticate="Bearer")
        try:
            fields = dict(parse_qsl(request.query, keep_blank_values=True, max_num_fields=FIELDS_MAX))
            found = self._carry_out(method, path, fields)
        except (OperatorError, WorldsError) as error:
            return line(HTTPStatus.CONFLICT, str(error))
        except ValueError as error:
            return line(HTTPStatus.BAD_REQUEST, f"query: {error}")
        return line(HTTPStatus.NOT_FOUND, f"{method} {path}: no such request") if found is None else json_answer(found)

    def _carry_out(self, method: str, path: str, fields: dict[str, str]) -> dict[str, Any] | None:
        """Carries out a request. Returns the answer; None: there is no such request.

        Raises:
            OperatorError, WorldsError: it cannot be carried out.
        """
        match method, path.split("/")[1:]:
            case "GET", ["worlds"]:
                return {"worlds": self._worlds.entries(named=True), "asleep": [*self._worlds.asleep]}
            case "POST", ["worlds"]:
                return self._create(fields)
            case "DELETE", ["worlds", name]:
                self._worlds.end(name, _reason(fields) or REASON)
                return {"name": name}
            case "POST", ["worlds", name, "kick"]:
                return self._kick(name, fields)
            case "POST", ["drain"]:
                self._drain(_seconds(fields))
                return {"worlds": len(self._worlds.worlds)}
        return None

    def _create(self, fields: dict[str, str]) -> dict[str, Any]:
        kind, name = fields.pop("kind", ""), fields.pop("name", "")
        private = fields.pop("private", "0") in ("1", "true")
        world = self._worlds.create(kind, fields, private=private, name=name)
        return {"name": world.name, "code": world.code, "path": f"/{world.name}"}

    def _kick(self, name: str, fields: dict[str, str]) -> dict[str, Any]:
        running, number = self._host.running.get(name), fields.get("player", "")
        if running is None:
            raise WorldsError(f"there is no world {name[:40]!r}")
        entity = int(number) if number.isascii() and number.isdecimal() and len(number) < 20 else 0
        player = running.game.players.get(entity)
        if player is None:
            raise OperatorError(f"player = {number[:40]!r}: is no player of the world {name}; give the entity's number")
        reason = _reason(fields)

        def kick() -> None:
            if running.game.players.get(entity) is player:
                running.game.api.kick(player, reason)

        running.game.api.soon(kick)
        return {"name": name, "player": player.name}


def _reason(fields: dict[str, str]) -> str:
    """Returns the reason in a request; empty if there is none.

    Raises:
        OperatorError: it is too long.
    """
    reason = fields.get("reason", "")
    if len(reason) > REASON_MAX:
        raise OperatorError(f"reason: longer than {REASON_MAX} characters")
    return reason


def _seconds(fields: dict[str, str]) -> float | None:
    """Returns the time of draining in a request; None if there is none.

    Raises:
        OperatorError: it is no number in the range.
    """
    text = fields.get("within_s")
    if text is None:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds <= DRAIN_MAX_S:
        raise OperatorError(f"within_s = {text[:40]!r}: must be a number from 0 to {DRAIN_MAX_S:g}")
    return seconds
