"""The commands of one client that the server has not answered yet; after a reconnect they are sent again."""

from typing import Any

from client_sdk.events import Answered
from shared import edits, fields, messages, payloads
from shared.checks import text
from shared.messages import Command, Refusal, encode
from shared.snapshot import VERDICT


class SentCommands:
    """The commands without a result, by number."""

    def __init__(self) -> None:
        self._number = 0
        self._unanswered: dict[int, bytes] = {}
        self._ticks: dict[int, int] = {}
        self._reasons: dict[int, str] = {}
        """Reasons of refusals whose verdicts have not arrived yet."""

    def number(self) -> int:
        """Allocates the next command number."""
        self._number += 1
        return self._number

    def tick(self, due: int) -> int:
        """Returns the tick of a new command: `due`, or that of the newest command without a result if it is later.

        The server carries out the commands of a player in their order. If the client's time has gone back meanwhile,
        a command for an earlier tick would wait there for those before it.

        Args:
            due: the next tick that has no input yet.
        """
        return max(due, next(reversed(self._ticks.values()), due))

    def command(self, tick: int, seen: float, name: str, data: Any) -> Command:
        """Returns a new command to the rules of the game.

        Args:
            tick: the tick at which to carry it out.
            seen: the view tick, at which the player saw the other entities.
            name: name of the command, up to 32 characters.
            data: a value that MessagePack can hold, up to 1,024 bytes when packed.

        Raises:
            ValueError: the name or the data are too long, or MessagePack cannot hold the data.
        """
        if text(name, "name", fields.NAME_MAX) == edits.NAME:
            raise ValueError(f"name = {name!r}: must be another name, because the client uses this one for edits")
        try:
            payload = payloads.pack_value(data)
        except ValueError as error:
            raise ValueError(f"{name}: data = {error}") from error
        return Command(self.number(), tick, seen, name, payload)

    def file(self, command: Command) -> bytes:
        """Keeps a command until it is answered. Returns the message to send."""
        self._ticks[command.number] = command.tick
        return self._unanswered.setdefault(command.number, encode(command))

    def answer(self, verdicts: bytes) -> list[Answered]:
        """Takes the verdicts of a snapshot (`Snapshot.verdicts`). Returns one result per command.

        A second answer to a command that was sent twice is ignored.
        """
        answers = []
        for number, verdict in VERDICT.iter_unpack(verdicts) if verdicts else ():
            if self._unanswered.pop(number, None) is not None:
                del self._ticks[number]
                text = messages.VERDICT_TEXTS[min(verdict, len(messages.VERDICT_TEXTS) - 1)]
                text = self._reasons.pop(number, "") or text
                answers.append(Answered(number, verdict == messages.DONE, text))
        return answers

    def refused(self, refusal: Refusal) -> None:
        """Takes the reason of a refusal, for the verdict that follows."""
        if refusal.number in self._unanswered:
            self._reasons[refusal.number] = refusal.reason

    def again(self) -> list[bytes]:
        """Returns the messages to send again after a reconnect; the server knows which commands it has carried out."""
        return list(self._unanswered.values())

    def give_up(self, why: str) -> list[Answered]:
        """Forgets all commands, because the player is a new one to the server. Returns a failed result for each."""
        numbers = list(self._unanswered)
        self._unanswered.clear()
        self._ticks.clear()
        self._reasons.clear()
        return [Answered(number, False, why) for number in numbers]
