"""Records on a tape what reaches one client: messages, times, inputs and commands. `replayed.py` plays it again.

A tape is MessagePack: a list of calls of the core, each [name, arguments ...].
"""

from typing import Any

import msgpack

from client_sdk.core import Core
from client_sdk.view import View
from shared.buttons import Names
from shared.inputs import Input

DRAWN_S = 1 / 60
"""Time between two views that a tape takes, in seconds."""


class TapedCore(Core):
    """A core that records its calls. It draws a view after an update, 60 times per second."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.calls: list[tuple[Any, ...]] = []
        self._drawn = 0.0

    def tape(self) -> bytes:
        """Returns the tape."""
        packed: bytes = msgpack.packb(self.calls)
        return packed

    def open(self, now: float) -> None:
        self.calls.append(("open", now))
        super().open(now)

    def receive(self, data: bytes, now: float) -> None:
        self.calls.append(("receive", data, now))
        super().receive(data, now)

    def lost(self, code: int, reason: str, now: float) -> None:
        self.calls.append(("lost", code, reason, now))
        super().lost(code, reason, now)

    def update(self, now: float) -> None:
        self.calls.append(("update", now))
        super().update(now)
        if now >= self._drawn + DRAWN_S:
            self._drawn = now
            self.view(now)

    def view(self, now: float) -> View:
        self.calls.append(("view", now))
        return super().view(now)

    def outgoing(self) -> list[bytes]:
        self.calls.append(("outgoing",))
        return super().outgoing()

    def set_input(self, input_: Input, buttons: Names = ()) -> None:
        self.calls.append(("set_input", tuple(input_)))
        super().set_input(input_, buttons)

    def set_input_delay(self, ticks: int) -> None:
        self.calls.append(("set_input_delay", ticks))
        super().set_input_delay(ticks)

    def command(self, name: str, data: Any = None) -> int:
        self.calls.append(("command", name, data))
        return super().command(name, data)

    def edit(self, x: Any, y: Any, z: Any, kind: Any) -> int:
        self.calls.append(("edit", x, y, z, kind))
        return super().edit(x, y, z, kind)

    def dials(self, now: float) -> bool:
        due = super().dials(now)
        if due:
            self.calls.append(("trying",))
        return due
