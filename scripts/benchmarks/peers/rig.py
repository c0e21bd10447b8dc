"""The processes of a run of `bench.py peers`: a server, its clients, and the proxy between them."""

import contextlib
import json
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scripts.benchmarks.peers.figures import Figures, Logs, carried, played, served
from scripts.benchmarks.peers.install import PLACE
from scripts.benchmarks.server import RigError
from scripts.environment import ROOT
from scripts.loadgen.generator import LEAD_TICKS
from sovereign_netcode.stderr import Stderr

PATIENCE_S = 30.0
PREDICTED_MAX = 10
"""Players that predict; further ones only send, on both sides."""
RATE = 32
PROXIED_LEAD_TICKS = 12
"""Lead of our light players over the line of the proxy: both ways, and late reads."""
OURS = "ours"
SIDES = {OURS: "", "next()": "next", "for..of": "all"}
"""The sides by the name that is shown: ours, and Colyseus by the way in which its room takes inputs."""


class Child:
    """A process that answers lines on its stdin with JSON on its stdout."""

    def __init__(self, command: Sequence[str], cwd: Path = ROOT) -> None:
        self._errors = Stderr()
        try:
            self._process = subprocess.Popen(
                command, cwd=cwd, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors.pipe, text=True
            )
        finally:
            self._errors.started()
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def line(self) -> str:
        """Returns the next line, and waits for it."""
        try:
            return self._lines.get(timeout=PATIENCE_S)
        except queue.Empty:
            raise RigError(f"a process does not answer: {self._errors.cause(self._process.poll())}") from None

    def tell(self, command: str) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(command + "\n")
            self._process.stdin.flush()
        except OSError:
            raise RigError(f"a process has ended: {self._errors.cause(self._process.wait(PATIENCE_S))}") from None

    def ask(self, command: str) -> dict[str, Any]:
        self.tell(command)
        return dict(json.loads(self.line()))

    def stop_for(self, seconds: float) -> None:
        """Stops the process for a time, as an overloaded machine does."""
        self._process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(seconds)
        finally:
            self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """Ends the process: by the end of its stdin, then by signals."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        for end in (self._process.terminate, self._process.kill):
            try:
                self._process.wait(2.0)
                return
            except subprocess.TimeoutExpired:
                end()
        self._process.wait()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with contextlib.suppress(ValueError), self._process.stdout as lines:
            for line in lines:
                self._lines.put(line)


class Rig:
    """A server of one side with its clients, all playing. Use it with `with`.

    Args:
        side: one of `SIDES`.
        node: path of Node.js; not used for ours.
        players: number of players.
        proxied: whether the line of the proxy lies between server and clients.
        per_step: inputs that player 0 sends per step.
    """

    def __init__(self, side: str, node: str, players: int, *, proxied: bool, per_step: int = 1, seed: int = 1) -> None:
        self.players = players
        self._stack = contextlib.ExitStack()
        try:
            self._start(side, node, proxied, per_step, seed)
        except BaseException:
            self._stack.close()
            raise

    def _start(self, side: str, node: str, proxied: bool, per_step: int, seed: int) -> None:
        port = free_port()
        if side == OURS:
            walked = ("walked",) if per_step > 1 else ()
            self.server = self._child(module("our_server", str(port), *walked))
        else:
            self.server = self._child((node, "server.mjs", SIDES[side], str(port)), PLACE)
        self.server.line()
        self.proxy = self._child(module("proxy", str(port), str(seed))) if proxied else None
        if self.proxy is not None:
            port = json.loads(self.proxy.line())["port"]
        predicted = min(self.players, PREDICTED_MAX)
        light = self.players - predicted
        order = {"port": port, "players": predicted, "light": light, "seed": seed, "per_step": per_step}
        if side != OURS:
            self.clients = self._child((node, "clients.mjs", json.dumps(order)), PLACE)
        else:
            self.clients = self._child(module("our_clients", json.dumps(order)))
            if light:
                load = {"port": port, "seed": seed, "rate": RATE, "joins_per_s": 100.0, "jump_share": 0.0}
                load["lead_ticks"] = PROXIED_LEAD_TICKS if proxied else LEAD_TICKS
                generator = self._child((sys.executable, "-m", "scripts.loadgen.generator", json.dumps(load)))
                generator.tell(f"clients {light}")
                while json.loads(generator.line())["playing"] < light:
                    pass
        self.clients.line()

    def window(self, seconds: float) -> tuple["Window", "Window"]:
        """Returns the counters at the beginning and at the end of a time from now on."""
        before = Window(self)
        time.sleep(seconds)
        return before, Window(self)

    def figures(self, before: "Window", after: "Window") -> Figures:
        """Returns all figures of the time between two moments."""
        begin, end = before.server["now"], after.server["now"]
        found = played(self.logs(), begin, end) | served(before.server, after.server, self.players)
        if self.proxy is not None:
            found |= carried(before.line, after.line, self.players, end - begin)
        return found

    def logs(self) -> Logs:
        server, clients = self.server.ask("log"), self.clients.ask("log")
        sent = {name: {int(number): at for number, at in rows} for name, rows in clients["sent"].items()}
        return Logs(server["ticks"], server["inputs"], sent, clients["corrections"])

    def __enter__(self) -> "Rig":
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def _child(self, command: Sequence[str], cwd: Path = ROOT) -> Child:
        child = Child(command, cwd)
        self._stack.callback(child.close)
        return child


class Window:
    """The counters of a rig at one moment."""

    def __init__(self, rig: Rig) -> None:
        self.server: Mapping[str, Any] = rig.server.ask("mark")
        self.line: Mapping[str, int] = rig.proxy.ask("mark") if rig.proxy is not None else {}


def module(name: str, *arguments: str) -> tuple[str, ...]:
    return (sys.executable, "-m", f"scripts.benchmarks.peers.{name}", *arguments)


def free_port() -> int:
    """Returns a port of loopback that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
