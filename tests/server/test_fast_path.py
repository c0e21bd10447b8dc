"""The fast path against the specification: whatever clients do, every byte that is sent is the same, and every count.

A seeded crowd of clients plays on two games, one with the fast path and one without. It sends inputs that come late,
twice, too early or with gaps, malformed messages, commands, pings and restarts; its lines stall; it reconnects and
walks from segment to segment. The rules send events and values, and read inputs.
"""

import functools
import io
import random
import secrets
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from server.config.limits import Limits
from server.game import Game
from server.game.fast_path import PATIENCE_MAX, FastPath
from server.game.session import Session
from server.net.websocket import _frame_head
from server.players.player import Player
from server.rules import Rules
from shared import kernels, messages
from shared.fields import AFTER_MAX
from shared.inputs import JUMP, Input, clamp, row
from shared.messages import (
    Bye,
    Command,
    Held,
    Hello,
    Inputs,
    Ping,
    Restart,
    Resync,
    Snapshot,
    Welcome,
    decode_from_server,
    encode,
)
from shared.payloads import pack_value
from shared.scene import Scene, Template

pytestmark = pytest.mark.skipif(not kernels.available(), reason="there is no compiled kernel")

PEERS = 10


def crowd_scene(*, aim: bool = False, rate: int = 30) -> Scene:
    """Returns a flat scene of 3 x 3 segments."""
    person = Template("person", (-0.3, -0.3, 0), (0.6, 0.6, 1.8), walk_speed=12, jump_speed=8)
    return Scene(
        name="crowd",
        templates=(person,),
        player="person",
        tick_rate=rate,
        gravity=16.0,
        size=(3, 3, 1),
        spawns=tuple((28.0 + 4 * x, 28.0 + 4 * y, 1.0) for x in range(5) for y in range(5)),
        terrain={"generator": "boxes", "fill": [[0, 0, 0, 96, 96, 1, 1]]},
        aim=aim,
    )


class Busy(Rules):
    """Rules that answer commands in every way there is, and write down the inputs that they see."""

    def __init__(self) -> None:
        self.seen: list[Any] = []

    def on_tick(self) -> None:
        for player in list(self.game.players.values())[:2]:
            self.seen.append((self.game.tick, self.game.move(player), self.game.held(player, "jump")))
        for player in self.game.players.values():
            if (self.game.tick + 11 * player.entity) % 37 == 0:
                self.game.throw(player.entity, (3.0, -1.0, 4.0))

    def on_command(self, player: Player, name: str, payload: Any) -> bool | str | None:
        game = self.game
        if name == "event":
            game.send("heard", payload)
        elif name == "whisper":
            game.send("heard", payload, to=[player])
        elif name == "shared":
            game.share("n", payload)
        elif name == "private":
            game.share_with(player, "n", payload)
        elif name == "attribute":
            game.set(player.entity, "n", payload)
        elif name == "jump":
            game.place(player.entity, (8.0 + payload % 80, 8.0 + payload % 79, 3.0))
        elif name == "refuse":
            return "no"
        elif name == "shot":
            game.rewound(player).ray(game.position(player.entity), (1.0, 0.0, 0.0), 8.0)
        return None


def masked(message: bytes) -> bytes:
    """Returns a message in the frame of a client."""
    n, mask = len(message), b"\x5a\x13\xc7\x2e"
    head = bytes((0x82, 0x80 | n)) if n < 126 else b"\x82\xfe" + n.to_bytes(2, "big")
    return head + mask + bytes(byte ^ mask[i % 4] for i, byte in enumerate(message))


NAMES = "event whisper shared private attribute jump refuse shot".split()


class Peer:
    """A client and its link. All that it does depends on its seed, and on what it was sent."""

    def __init__(self, crowd: "Crowd", number: int) -> None:
        self.crowd, self.number = crowd, number
        self.rng = random.Random(f"{crowd.seed} {number}")
        self.holds = number % 2 == 1
        """Whether it leaves out inputs that stay the same."""
        self.sent: list[tuple[int, bytes]] = []
        self.closings: list[tuple[int, int, str]] = []
        self.resume = b""
        self.commands = 0
        self.session: Session | None = None
        self.open()

    def open(self) -> None:
        self.acked = self.next = -1
        self.stalled = self.waiting = 0
        self.said = Input(1)
        self.latest = self.next
        self.move = Input()
        self.session = self.crowd.game.open(self, self.crowd.now)
        self.say(encode(Hello(messages.VERSION, {}, f"peer {self.number}", resume=self.resume)))

    # -- the link

    def send(self, message: bytes) -> None:
        assert type(message) is bytes
        self.sent.append((self.crowd.game.world.tick, message))
        self.waiting += len(message)
        got = decode_from_server(message)
        if isinstance(got, Welcome):
            self.resume, self.next = got.resume, got.tick + 3
        elif isinstance(got, Snapshot) and not self.stalled:
            self.acked = got.tick

    def outstanding(self) -> int:
        if not self.stalled:
            self.waiting = 0
        return self.waiting

    def close(self, code: int, reason: str) -> None:
        self.closings.append((self.crowd.game.world.tick, code, reason))
        self.lose()

    # -- the client

    def lose(self) -> None:
        session, self.session = self.session, None
        if session is not None:
            self.crowd.game.lost(session, self.crowd.now)

    def say(self, data: bytes) -> None:
        if self.session is not None:
            self.crowd.game.receive(self.session, data, self.crowd.now)

    def act(self, busy: float) -> None:
        """Does what the client does in one tick.

        Args:
            busy: how often it does something else than sending the input of the next tick, from 0 to 1.
        """
        rng = self.rng
        if self.session is None:
            if rng.random() < 0.1:
                self.open()
            return
        self.stalled = max(self.stalled - 1, 0) or (rng.random() < 0.02 * busy) * rng.randrange(1, 60)
        if rng.random() < 0.1:
            aim = (rng.randrange(-99, 99), 5, 7) if self.crowd.game.scene.aim else (0, 0, 0)
            self.move = clamp(Input(rng.randrange(-127, 128), rng.randrange(-127, 128), rng.randrange(2) * JUMP, aim))
        if self.next >= 0 and not (busy and rng.random() < 0.03):
            self.say_inputs(1 if rng.random() < 0.9 else rng.randrange(3))
        if rng.random() < 1 / 30:
            self.say(encode(Ping(rng.random(), rng.randrange(3))))
        if self.next >= 0 and rng.random() < busy:
            self.do_something_else()

    def say_inputs(self, n: int) -> None:
        after = self.next - self.latest
        if self.holds and self.move == self.said and n == 1 and after <= AFTER_MAX:
            if after > self.rng.randrange(3):
                self.say(encode(Held(after, max(self.next - self.acked, 0))))
                self.latest = self.next
        else:
            rows = row(self.move, aim=self.crowd.game.scene.aim) * n
            self.say(encode(Inputs(self.next, self.acked, rows)))
            self.said, self.latest = self.move if n else self.said, max(self.next + n - 1, self.latest)
        self.next += n

    def do_something_else(self) -> None:
        rng, tick = self.rng, self.crowd.game.world.tick
        kind = rng.randrange(12)
        if kind < 4:
            self.commands += 1
            x, y = rng.randrange(96), rng.randrange(96)
            name, data = rng.choice([(rng.choice(NAMES), rng.randrange(300)), ("edit", [x, y, rng.randrange(4), 2])])
            self.say(encode(Command(self.commands, tick + 1, float(tick), name, pack_value(data))))
        elif kind == 4:
            self.next = tick + rng.randrange(-40, 90)
        elif kind == 5:
            self.next -= rng.randrange(1, 4)
        elif kind == 6:
            self.next += rng.randrange(1, 4)
        elif kind == 7:
            at = tick + rng.randrange(-1, 4)
            self.say(encode(Restart(max(at, 0))))
        elif kind == 8:
            self.say(encode(Resync()))
        elif kind == 9 and rng.random() < 0.2:
            good = encode(Inputs(max(self.next, 0), self.acked, row(self.move, aim=self.crowd.game.scene.aim)))
            held = encode(Held(rng.randrange(1, 4), rng.randrange(300)))
            self.say(
                rng.choice(
                    [
                        held,
                        held[:-1],
                        held + b"\0",
                        b"\x93\x09\0\0",
                        good[:-1],
                        good + b"\0",
                        b"",
                        b"\x94\x02",
                        rng.randbytes(9),
                        good[:2] + b"\xff" * 9,
                    ]
                )
            )
        elif kind == 10 and rng.random() < 0.2:
            self.say(encode(Bye(1000, "", -1.0))) if rng.random() < 0.3 else self.lose()
        elif kind == 11:
            for _ in range(rng.randrange(1, 30)):  # then it is far ahead
                self.say_inputs(1)


class FramedPeer(Peer):
    """A client whose link takes and gives whole WebSocket frames, like `server.net.websocket.Connection`."""

    def open(self) -> None:
        self.inlet: Callable[[bytes, float], bool] | None = None
        self.in_frames = 0
        super().open()

    def outlet(self) -> Callable[[bytes], None]:
        return self.send_frame

    def send_frame(self, frame: bytes) -> None:
        assert type(frame) is bytes
        head = 2 if frame[1] < 126 else 4
        message = frame[head:]
        assert frame[:head] == _frame_head(len(message))
        self.send(message)

    def say(self, data: bytes) -> None:
        if self.inlet is not None and self.inlet(masked(data), self.crowd.now):
            self.in_frames += 1
        else:
            super().say(data)


class Crowd:
    """A game with its clients."""

    def __init__(
        self,
        seed: int,
        scene: Scene,
        attach: Callable[[Game], None],
        *,
        busy: float,
        rules: Rules,
        kind: type[Peer] = Peer,
    ) -> None:
        self.seed, self.busy, self.rules, self.now = seed, busy, rules, 0.0
        self.recording = io.BytesIO()
        tokens = random.Random(seed)
        limits = Limits(resume_s=1.0, silence_s=3.0, stalled_s=2.0, input_rows_max=4, edits_per_s=50.0)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(secrets, "token_bytes", tokens.randbytes)
            self.game = Game(scene, limits=limits, rules=rules, fast_path=False)
            attach(self.game)
            self.on_fast_path = self.served = 0
            self.peers = [kind(self, number) for number in range(PEERS)]
            self.play(30 * PATIENCE_MAX // 4)

    def play(self, ticks: int) -> None:
        rng = random.Random(self.seed)
        for number in range(1, ticks + 1):
            deadline = number / self.game.scene.tick_rate
            if rng.random() < 0.002:
                deadline += rng.random() * 2  # the server was suspended
            late = max(self.now, deadline + rng.random() * 0.003)
            moments = sorted((rng.random(), peer) for peer in range(PEERS))
            began = self.now
            for moment, peer in moments:
                self.now = began + moment * (late - began)
                self.peers[peer].act(self.busy)
            self.now = late
            self.on_fast_path += sum(session.row >= 0 for session in self.game.sessions)
            self.served += len(self.game.sessions)
            self.game.tick(deadline, late)
            if number == ticks // 2 and self.seed % 2:
                self.game.world.record(self.recording)

    def record(self) -> list[Any]:
        """Returns all that can be seen of the game from outside."""
        seen = self.rules.seen if isinstance(self.rules, Busy) else []
        sent = [(peer.sent, peer.closings) for peer in self.peers]
        return [sent, seen, self.game.stats(), self.game.world.state_hash(), self.recording.getvalue()]


def with_fast_path(kernel: kernels.Kernel | None = None) -> Callable[[Game], None]:
    """Returns a function that gives a game a fast path, with a kernel or with that of its world."""

    def attach(game: Game) -> None:
        path = FastPath(
            game.world, game.log, game.limits, game.counters, game.clocks, game.players, game.connections, game.receive,
            kernel or game.world.kernel,
        )  # fmt: skip
        game.fast_path = game.sequencer.fast_path = path

    return attach


def without(game: Game) -> None:
    """Leaves a game as it is."""


@pytest.fixture(scope="module", autouse=True)
def _forget() -> Iterator[None]:
    """Frees the records that were kept for the tests of this module."""
    yield
    specified.cache_clear()


@functools.cache
def specified(aim: bool, rate: int, busy: float) -> list[Any]:
    """Returns the record of a game without the fast path. All forms of the fast path are compared with the same one."""
    crowd = Crowd(seed_of(aim, rate, busy), crowd_scene(aim=aim, rate=rate), without, busy=busy, rules=Busy())
    assert crowd.on_fast_path == 0
    return crowd.record()


def seed_of(aim: bool, rate: int, busy: float) -> int:
    return round(1000 * busy) + rate + aim


@pytest.mark.parametrize("busy", [0.2, 0.01, 0.0])
@pytest.mark.parametrize(("aim", "rate"), [(False, 30), (True, 30), (False, 240), (True, 8)])
@pytest.mark.parametrize("kind", [FramedPeer, Peer])
def test_every_byte_is_the_same(compiled: bool, kind: type[Peer], aim: bool, rate: int, busy: float) -> None:
    scene, seed = crowd_scene(aim=aim, rate=rate), seed_of(aim, rate, busy)
    fast = Crowd(seed, scene, with_fast_path(kernels.get(compiled)), busy=busy, rules=Busy(), kind=kind)
    for one, other in zip(fast.record(), specified(aim, rate, busy), strict=True):
        assert one == other
    least = {0.0: 0.6, 0.01: 0.2, 0.2: 0.02}[busy] if rate > 8 else 0.02  # at 8 Hz, a segment is crossed in 20 ticks
    assert fast.on_fast_path > least * fast.served, "the fast path was used"
    if kind is FramedPeer:
        assert sum(peer.in_frames for peer in fast.peers if isinstance(peer, FramedPeer)) > 0


class Steady(Peer):
    """A client that stands still, and sends one input in each tick of its own time."""

    def act(self, busy: float) -> None:
        if self.next >= 0:
            self.say_inputs(1)


@pytest.mark.parametrize("times", [2, 6])
def test_sessions_stay_on_the_fast_path_while_the_server_skips_ticks(times: int) -> None:
    crowds = [
        Crowd(4, crowd_scene(), attach, busy=0.0, rules=Rules(), kind=Steady) for attach in (with_fast_path(), without)
    ]
    for crowd in crowds:
        game, ticks = crowd.game, 40
        before = game.world.tick
        for _ in range(ticks):  # inputs come for ticks further and further ahead, beyond those that are accepted
            for _ in range(times):
                for peer in crowd.peers:
                    peer.act(0.0)
            crowd.now += times / game.scene.tick_rate
            game.tick(crowd.now, crowd.now)
        assert game.world.tick == before + ticks
        assert min(peer.next for peer in crowd.peers) > game.world.tick + (times - 1) * ticks
    fast, slow = crowds
    assert all(session.row >= 0 for session in fast.game.sessions)
    assert fast.record() == slow.record()
    assert (fast.game.stats()["inputs_refused"] > 0) == (times > 2)
