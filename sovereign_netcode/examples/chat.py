"""Chat: players walk about and talk, to all or to one, and moderators remove those who do not behave.

    sovereign-server --game sovereign_netcode.examples.chat:Chat --option moderators=ann,bo --auth token ...

Chat is no feature of the server: these rules are all of it. Copy what your own game needs.
"""

from typing import Any

from sovereign_netcode.server import Player, Rules, words
from sovereign_netcode.shared.fields import NAME_MAX

LINE_MAX = 160
"""Longest message, in characters."""
LINES, WINDOW_S = 4, 8.0
"""Number of messages that a player may send within `WINDOW_S` seconds."""
COMMANDS = {
    "say": {"text": words(LINE_MAX)},
    "whisper": {"to": words(NAME_MAX, 1), "text": words(LINE_MAX)},
    "kick": {"who": words(NAME_MAX, 1)},
}
OPTIONS = {"moderators": words(1000, default="")}
"""Options of the game. `moderators`: subjects of the tokens of those who may kick, with commas between."""


class Chat(Rules):
    """The rules of a chat.

    Commands: see `COMMANDS`; each is refused with a reason. Events: "said" to all and "whispered" to two players, with
    {"by": entity, "text"}; "came" and "went", with {"who"}.
    """

    scene = "flat"
    names = "unique"
    commands = COMMANDS
    options = OPTIONS
    moderators: str

    def __init__(self) -> None:
        self._lines: dict[int, list[int]] = {}
        """Ticks of the latest messages, by the entity of the player."""

    def on_join(self, player: Player) -> None:
        self.game.send("came", {"who": player.name})

    def on_leave(self, player: Player) -> None:
        self._lines.pop(player.entity, None)
        self.game.send("went", {"who": player.name})

    def on_command(self, player: Player, name: str, payload: Any) -> bool | str | None:
        if name == "kick":
            return self._kick(player, payload["who"])
        message = tidy(payload["text"])
        if not message:
            return "there is nothing to say"
        others = None
        if name == "whisper":
            other = self._named(payload["to"])
            if other is None:
                return f"nobody here is called {payload['to']}"
            others = {player, other}
        if not self._may_speak(player.entity):
            return f"at most {LINES} messages in {WINDOW_S:.0f} s"
        self.game.send("said" if others is None else "whispered", {"by": player.entity, "text": message}, others)
        return True

    def _kick(self, player: Player, name: str) -> bool | str:
        if not player.subject or player.subject not in self.moderators.split(","):
            return "only moderators can do that"
        other = self._named(name)
        if other is None:
            return f"nobody here is called {name}"
        self.game.kick(other, f"removed by {player.name}", for_s=600)
        return True

    def _named(self, name: str) -> Player | None:
        players = self.game.players.values()
        return next((player for player in players if player.name.casefold() == name.casefold()), None)

    def _may_speak(self, entity: int) -> bool:
        """Counts a message of a player. Returns False if these are too many."""
        since = self.game.tick - self.game.ticks(WINDOW_S)
        lines = [tick for tick in self._lines.get(entity, ()) if tick > since]
        allowed = len(lines) < LINES
        self._lines[entity] = [*lines, self.game.tick] if allowed else lines
        return allowed


def tidy(text: str) -> str:
    """Returns a message without line ends and hidden characters, with single spaces."""
    return " ".join("".join(character if character.isprintable() else " " for character in text).split())
