"""Messages in the window: Enter opens the line, and the rules get what was typed."""

import os

os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

import pygame
import pytest

from client_sdk.loopback import Loopback
from server import Game, Player, Rules, words
from shared.scene import load_scene
from sovereign_netcode.play.chat import LONGEST, Chat
from sovereign_netcode.play.keys import commands_of
from sovereign_netcode.play.window import Window, keyboard

COMMANDS = {"say": {"text": words(200, 1)}, "ready": {}}


class Talk(Rules):
    """Rules that pass on what players say, and count who is ready."""

    scene = "flat"
    commands = COMMANDS
    keys = {"ready": "r"}  # noqa: RUF012

    def on_start(self) -> None:
        self.game.share("ready", 0)

    def on_command(self, player: Player, name: str, payload: dict[str, str]) -> bool:
        if name == "say":
            self.game.send("said", {"by": player.entity, "text": payload["text"]})
        else:
            self.game.share("ready", self.game.shared["ready"] + 1)
        return True


def key(code: int, text: str = "") -> pygame.event.Event:
    return pygame.event.Event(pygame.KEYDOWN, key=code, unicode=text)


def typed(chat: Chat, text: str) -> None:
    for letter in text:
        assert chat.handle(key(0, letter)) == (True, "")


def test_enter_opens_the_line_and_sends_what_was_typed() -> None:
    chat = Chat(COMMANDS)
    assert chat.handle(key(pygame.K_w, "w")) == (False, "")
    assert chat.handle(key(pygame.K_RETURN)) == (True, "")
    typed(chat, " hi!!")
    assert chat.handle(key(pygame.K_BACKSPACE)) == (True, "")
    assert chat.text == " hi!"
    assert chat.handle(key(pygame.K_RETURN)) == (True, "hi!")
    assert chat.text is None


def test_escape_closes_the_line_and_a_text_is_bounded() -> None:
    chat = Chat(COMMANDS)
    chat.handle(key(pygame.K_RETURN))
    typed(chat, "x" * (LONGEST + 5))
    assert chat.text == "x" * LONGEST
    assert chat.handle(key(pygame.K_ESCAPE)) == (True, "")
    assert chat.text is None


def test_a_game_without_messages_has_no_line() -> None:
    chat = Chat({"ready": {}})
    assert chat.handle(key(pygame.K_RETURN)) == (False, "")


def test_a_key_of_a_command_must_exist() -> None:
    pygame.display.init()
    assert commands_of({"ready": "r", "dash": "x"}, COMMANDS) == {pygame.K_r: "ready"}
    with pytest.raises(RuntimeError, match="no key at all"):
        commands_of({"ready": "no key at all"}, COMMANDS)


def test_the_window_sends_messages_and_commands() -> None:
    pygame.display.init()
    pygame.font.init()
    rules = Talk()
    client = Loopback(Game(load_scene("flat"), rules=rules)).join("Ann")
    window = Window(client, keyboard, "Talk", rules.keys, rules.commands)
    frames = iter(range(10_000))
    seen: list[str] = []

    def run(seconds: float, *events: pygame.event.Event) -> None:
        for event in events:
            pygame.event.post(event)
        for _ in range(round(seconds * 20)):
            window.frame(next(frames) / 20)
            seen.extend(str(event) for event in window.events)

    run(2)
    run(1, key(pygame.K_RETURN), key(pygame.K_r, "r"), key(pygame.K_RETURN))
    run(1, key(pygame.K_r, "r"))
    assert any("'text': 'r'" in text for text in seen), "the first r was typed"
    assert client.shared["ready"] == 1, "the second one was the command's key"
    pygame.display.quit()
