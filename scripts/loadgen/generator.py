"""A generator of load for `bench.py server`: a thousand players in one process, without prediction and world.

argument  {"port", "seed", "rate", "joins_per_s", "paths", "lead_ticks", "jump_share"}, as JSON; the last three may be
          left out. The players join the paths in turn, each of which is a world; without "paths" the default one
stdin     a command per line: "clients N": connect or disconnect until there are N; "leaving N": the oldest client
          leaves N times per second and is replaced; "begin": the window begins; "end": the window ends, report its
          figures. The end of the pipe: stop
stdout    a JSON object per line: {"playing", "gone", "clients"} every `REPORT_S`, and the window's figures after "end"

Every client sends a hello, pings once a second, acknowledges, and has an input for each tick, `LEAD_TICKS` ahead of the
server's time, at its own moment within the tick, whether or not snapshots arrive. Like the SDK, it sends an input that
has changed, and says 16 times a second that one stays the same. It wanders: a new direction about once a second, and an
occasional jump. It reads only the first bytes of most messages.

Between the slots the process sleeps instead of waiting for its sockets. Waking another process takes the server's time,
a tenth of it in a virtual machine. Clients on other machines would not cost that.
"""

import contextlib
import gc
import json
import math
import os
import select
import sys
import time
from typing import Any

from client_sdk.sent_inputs import RENEW_S
from scripts.loadgen.player import PING_S, Player, WorldTime, frame
from server.observability.histogram import between
from shared import fields, messages
from shared.bounds import bounds, in_ticks
from shared.messages import Bye, Held, Hello, Inputs, Message, Ping, decode_from_server, encode

LEAD_TICKS = 2
"""Ticks from sending an input to the deadline of its tick, at most. An input is sent up to a tick later than that.
Over a line with a delay it has to be longer."""
JUMP_SHARE = 0.01
"""Share of the inputs that jump."""
REPORT_S = 0.2
SLOT_S = 0.001
"""Length of a slot in seconds. Each client sends in one slot of every tick."""
CATCH_UP_SLOTS = 16
"""Most slots that are due and run without reading messages in between."""
ARRAY16, UINT8, UINT16, UINT32 = 0xDC, 0xCC, 0xCD, 0xCE
SNAPSHOT, TERRAIN, WELCOME, PONG = 18, 19, 17, 20


def number(data: bytes, at: int) -> tuple[int, int]:
    """Returns a number as MessagePack packs it, from -1 to 2³² - 1, and where the next value begins."""
    form = data[at]
    if form == UINT32:
        return int.from_bytes(data[at + 1 : at + 5], "big"), at + 5
    if form == UINT16:
        return data[at + 1] << 8 | data[at + 2], at + 3
    if form == UINT8:
        return data[at + 1], at + 2
    return (form, at + 1) if form < 0x80 else (-1, at + 1)


class Swarm:
    """All players, and the counts since the start of the window."""

    def __init__(self, order: dict[str, Any]) -> None:
        self.order = order
        self.rate: int = order["rate"]
        self.repeats, self.renew = bounds(self.rate).repeats, in_ticks(RENEW_S, self.rate, 1)
        self.lead_ticks: int = order.get("lead_ticks", LEAD_TICKS)
        self.jump_share: float = order.get("jump_share", JUMP_SHARE)
        self.slots = max(1, round(1 / self.rate / SLOT_S))
        self.poll = select.epoll()
        self.players: dict[int, Player] = {}
        self.by_slot: list[list[Player]] = [[] for _ in range(self.slots)]
        self.made = self.gone = self.wanted = 0
        self.leaving_per_s = 0.0
        self.worlds = [(path, WorldTime()) for path in order.get("paths", ["/"])]
        self.reset()

    def reset(self) -> None:
        self.began, self.cpu_0 = time.monotonic(), time.process_time()
        self.bytes_down = self.bytes_up = self.inputs = self.stuck = 0
        self.ages_ms: list[int] = [0] * 2048
        self.late_ms: list[int] = [0] * 2048
        for player in self.players.values():
            player.snapshots = 0

    # -- receiving -----------------------------------------------------------------------------------------

    def receive(self, player: Player, now: float) -> None:
        try:
            data = player.sock.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.drop(player)
            self.gone += 1
            return
        self.bytes_down += len(data)
        if player.buffer:
            data = player.buffer + data
        at, size = 0, len(data)
        if not player.open:
            end = data.find(b"\r\n\r\n")
            if end < 0:
                player.buffer = data
                return
            player.open, at = True, end + 4
            player.sock.send(frame(encode(Hello(messages.VERSION, {}, f"player {player.number}"))))
        while size - at >= 2:
            length, start = data[at + 1], at + 2
            if length == 126:
                if size - at < 4:
                    break
                length, start = data[at + 2] << 8 | data[at + 3], at + 4
            elif length == 127:
                if size - at < 10:
                    break
                length, start = int.from_bytes(data[at + 2 : at + 10], "big"), at + 10
            if start + length > size:
                break
            if data[at] != 0x82:  # not a binary frame: the server closes the connection
                self.drop(player)
                self.gone += 1
                return
            self.take(player, data, start, start + length, now)
            at = start + length
        player.buffer = data[at:]

    def take(self, player: Player, data: bytes, start: int, end: int, now: float) -> None:
        """Handles one message."""
        if data[start] == ARRAY16:
            tick, after = number(data, start + 4)
            player.acked, player.received = tick, number(data, after)[0]
            player.snapshots += 1
            if player.time.tick_0 > -math.inf:
                age_ms = int((now * self.rate + player.time.tick_0 - tick) / self.rate * 1e3)
                self.ages_ms[min(max(age_ms, 0), 2047)] += 1
        elif data[start + 1] == PONG:
            pong = decode_from_server(data[start:end])
            assert isinstance(pong, messages.Pong)
            player.time.learn(pong.tick - now * self.rate, now)
        elif data[start + 1] == WELCOME:
            self.by_slot[int(player.phase * self.slots)].append(player)
        # Terrain is ignored, because these clients have no world.

    # -- sending -------------------------------------------------------------------------------------------

    def send(self, player: Player, now: float) -> None:
        """Sends the inputs up to the tick that is due."""
        if now - player.pinged >= PING_S:
            player.pinged = now
            self.out(player, frame(encode(Ping(time.monotonic()))))
        tick_0 = player.time.tick_0
        if player.acked < 0 or tick_0 == -math.inf:
            return
        due = int(now * self.rate + tick_0 + self.lead_ticks)
        n = min(due - player.sent, fields.INPUT_ROWS_MAX) if player.sent >= 0 else 1
        if n <= 0:
            return
        rng = player.rng
        if rng.random() < n / self.rate:
            angle = rng.random() * math.tau
            player.move = bytes((int(127 * math.cos(angle)) & 0xFF, int(127 * math.sin(angle)) & 0xFF, 0))
        row = player.move
        if rng.random() < self.jump_share:
            row = row[:2] + b"\1"
        player.sent = due
        self.inputs += n
        if row != player.row or n > self.repeats or player.acked > due:
            message: Message = Inputs(due - n + 1, player.acked, row * n)
            player.row, player.due, player.changed = row, due + 1, due
        elif due >= player.due:
            message = Held(due - player.said, due - player.acked)
            player.due = due + (self.renew if player.received >= player.changed else 1)
        else:
            return
        player.said = due
        self.out(player, frame(encode(message)))

    def out(self, player: Player, data: bytes) -> None:
        try:
            sent = player.sock.send(data)
        except BlockingIOError:
            sent = 0
        except OSError:
            return  # the next read reports the error
        self.bytes_up += sent
        if sent < len(data):  # the server has not read for a long time: give up
            self.stuck += 1
            self.drop(player)
            self.gone += 1

    # -- the loop ------------------------------------------------------------------------------------------

    def run(self) -> None:
        self.poll.register(0, select.EPOLLIN)
        os.set_blocking(0, False)
        slot, begun = 0, time.monotonic()
        next_join = next_report = next_leave = begun
        commands = b""
        while True:
            now = time.monotonic()
            due = begun + slot / (self.slots * self.rate)
            for _ in range(CATCH_UP_SLOTS):  # then messages are read, even if more slots are due
                if due > now:
                    break
                players = self.by_slot[slot % self.slots]
                if players:
                    self.late_ms[min(int((now - due) * 1e3), 2047)] += 1
                    for player in tuple(players):
                        self.send(player, due)
                    now = time.monotonic()
                slot += 1
                due = begun + slot / (self.slots * self.rate)
            if len(self.players) < self.wanted and now >= next_join:
                next_join = max(now, next_join) + 1 / self.order["joins_per_s"]
                self.join()
            elif len(self.players) > self.wanted:
                self.drop(self.players[next(reversed(self.players))])
            if self.leaving_per_s and now >= next_leave and self.players:
                next_leave = max(now, next_leave) + 1 / self.leaving_per_s
                self.leave(next(iter(self.players.values())))
            if now >= next_report:
                next_report = now + REPORT_S
                playing = sum(player.acked >= 0 for player in self.players.values())
                say({"playing": playing, "gone": self.gone, "clients": len(self.players)})
            time.sleep(max(0.0, due - time.monotonic()))
            for fd, _ in self.poll.poll(0, 4096):
                if fd == 0:
                    with contextlib.suppress(BlockingIOError):
                        told = os.read(0, 4096)
                        if not told:
                            return
                        commands += told
                    while b"\n" in commands:
                        line, _, commands = commands.partition(b"\n")
                        self.obey(line.decode().split())
                elif fd in self.players:
                    self.receive(self.players[fd], time.monotonic())

    def obey(self, command: list[str]) -> None:
        match command:
            case ["clients", n]:
                self.wanted = int(n)
            case ["leaving", n]:
                self.leaving_per_s = float(n)
            case ["begin"]:
                gc.collect()
                gc.freeze()
                self.reset()
            case ["end"]:
                say(self.figures())

    def join(self) -> None:
        path, time = self.worlds[self.made % len(self.worlds)]
        player = Player(self.made, self.order["port"], self.order["seed"], path, time)
        self.made += 1
        self.players[player.sock.fileno()] = player
        self.poll.register(player.sock.fileno(), select.EPOLLIN)

    def leave(self, player: Player) -> None:
        """Disconnects a player. Every other one sends a `Bye`; the server keeps the entities of the rest for a time."""
        if player.number % 2:
            self.out(player, frame(encode(Bye(messages.GOING_AWAY, "", -1.0))))
        self.drop(player)

    def drop(self, player: Player) -> None:
        fd = player.sock.fileno()
        if self.players.pop(fd, None) is not None:
            self.poll.unregister(fd)
            player.sock.close()
            slot = self.by_slot[int(player.phase * self.slots)]
            if player in slot:
                slot.remove(player)

    def figures(self) -> dict[str, Any]:
        """Returns the figures of the window."""
        seconds, n = time.monotonic() - self.began, max(1, len(self.players))
        counts = sorted(player.snapshots for player in self.players.values()) or [0]
        return {
            "seconds": seconds,
            "clients_in_window": len(self.players),
            "gone": self.gone,
            "stuck": self.stuck,
            "snapshots_worst": counts[0],
            "snapshots_p50": counts[len(counts) // 2],
            "snapshots_best": counts[-1],
            "snapshot_age_ms": quantiles(self.ages_ms),
            "inputs_per_client_per_s": self.inputs / n / seconds,
            "bytes_down_per_client_per_s": self.bytes_down / n / seconds,
            "bytes_up_per_client_per_s": self.bytes_up / n / seconds,
            "cpu_share": (time.process_time() - self.cpu_0) / seconds,
            "late_ms": quantiles(self.late_ms),
        }


def quantiles(counts: list[int]) -> dict[str, float]:
    """Returns p50, p99 and max of values that were counted by whole milliseconds, rounded up."""
    return between([], [(1000 * (ms + 1), n) for ms, n in enumerate(counts)])


def say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    Swarm(json.loads(sys.argv[1])).run()
