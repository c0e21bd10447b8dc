"""What the player has asked of the server: each order is answered once, and asked again after a lost connection."""

from typing import Any

import numpy as np

from client_sdk.events import Answered
from shared import edits, messages
from shared.checks import text
from shared.messages import Command, encode
from shared.snapshot import VERDICT


class Orders:
    """Those that are not answered yet."""

    def __init__(self) -> None:
        self._number = 0
        self._unanswered: dict[int, bytes] = {}

    def number(self) -> int:
        """That of a further order."""
        self._number += 1
        return self._number

    def command(self, tick: int, seen: float, name: str, data: Any) -> Command:
        """An order to the game's rules.

        Raises:
            ValueError: the name or the data are too long (32 characters, 1,024 bytes), or no MessagePack.
        """
        if text(name, "name", messages.NAME_MAX) == edits.NAME:
            raise ValueError(f"name = {name!r}: must be another one, which the client itself does not use")
        try:
            payload = messages.pack_value(data)
        except ValueError as error:
            raise ValueError(f"{name}: data = {error}") from error
        return Command(self.number(), tick, seen, name, payload)

    def file(self, command: Command) -> bytes:
        """Keeps an order until it is answered; what to send."""
        return self._unanswered.setdefault(command.number, encode(command))

    def answer(self, verdicts: bytes) -> list[Answered]:
        """The server's word on orders, as `Snapshot.verdicts`; without second answers to what was asked twice."""
        answers = []
        for number, verdict in np.frombuffer(verdicts, VERDICT).tolist() if verdicts else ():
            if self._unanswered.pop(number, None) is not None:
                text = messages.VERDICT_TEXTS[min(verdict, len(messages.VERDICT_TEXTS) - 1)]
                answers.append(Answered(number, verdict == messages.DONE, text))
        return answers

    def again(self) -> list[bytes]:
        """What to send once more, to a server that knows which of them it has carried out."""
        return list(self._unanswered.values())

    def give_up(self) -> list[Answered]:
        """Nobody will answer any more."""
        numbers = list(self._unanswered)
        self._unanswered.clear()
        return [Answered(number, False, "the connection was lost") for number in numbers]
