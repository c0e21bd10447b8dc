"""The fuzzing of a game: each fuzzed input is a player's next message. All queues of the game must stay bounded."""

import random
from collections.abc import Callable
from typing import Any

from scripts.loadgen.player import frame
from server.config.limits import Limits
from server.game import Game
from server.game.session import Session
from server.players.player import Player
from server.rules import Rules
from shared import edits, fields, messages
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.bounds import bounds
from shared.fields import COMMAND_MAX
from shared.inputs import clamp
from shared.messages import (
    Command,
    Held,
    Hello,
    Inputs,
    Ping,
    ProtocolError,
    Restart,
    Resync,
    Welcome,
    decode_from_client,
    decode_from_server,
    encode,
)
from shared.scene import Scene, Template

WELCOME = 17


class _Shooting(Rules):
    """Rules that query the past (lag compensation) for every command."""

    def on_command(self, player: Player, name: str, payload: Any) -> bool | None:
        self.game.rewound(player).ray(self.game.position(player.entity), (1.0, 0.5, -0.25), 16.0)
        self.game.set(player.entity, "last", name)
        self.game.send("heard", [name, self.game.tick])
        return None


class Juggler(Behaviour):
    """Does everything that a turn can do when buttons are pressed."""

    templates = ("person", "tall")
    spawns = 2
    n = field(bits=12, signed=True)
    last = field(bits=32)

    def turn(self, me: Body) -> None:
        x, y, z = me.position
        me.n = -me.n if me.n > 2000 else me.n + me.chance(9)
        if me.pressed("jump"):
            me.last = me.spawn("ball", (x, y, z + 1.0), (me.move[0] / 16, me.move[1] / 16, 4.0)) or 0
            me.announce("thrown", me.last)
        if me.released("jump"):
            me.become("tall" if me.template == "person" else "person")
            me.edit(int(x) + me.chance(5) - 2, int(y) + 1, int(z), 3)


class Ball(Behaviour):
    """Vanishes when it lies still, or after a while."""

    templates = ("ball",)
    age = field(bits=8)

    def turn(self, me: Body) -> None:
        me.age += 1
        me.wake(me.tick + 1)
        if me.age > 90 or me.velocity == (0.0, 0.0, 0.0):
            me.remove()


def fuzzed_scene(*, aim: bool, behaviours: bool) -> Scene:
    """Returns the scene of the fuzzed games."""
    person = Template("person", (-0.3, -0.3, 0), (0.6, 0.6, 1.8), walk_speed=5, jump_speed=8)
    scene = Scene(
        name="fuzz",
        templates=(person,),
        player="person",
        tick_rate=32,
        gravity=16.0,
        origin=(-1, -1, -1),
        size=(2, 2, 2),
        spawns=((0.5, 0.5, 1.0),),
        terrain={"generator": "boxes", "fill": [[-32, -32, 0, 32, 32, 1, 1]]},
        aim=aim,
    )
    if not behaviours:
        return scene
    scene = scene.with_template("tall", box_size=(0.6, 0.6, 2.4)).with_template("ball", box_size=(0.2, 0.2, 0.2))
    return scene.with_behaviours([Juggler, Ball])


class _Deaf:
    """A link that is sometimes congested, and that may report the loss of the connection while it is being closed."""

    def __init__(self, game: "FuzzedGame", number: int) -> None:
        self.game, self.number, self.waiting = game, number, 0
        self.next = 0
        """Tick of the next input of a client that behaves."""

    def send(self, message: bytes) -> None:
        assert len(message) <= fields.MESSAGE_MAX
        if message[1] == WELCOME:
            welcome = decode_from_server(message)
            assert isinstance(welcome, Welcome)
            self.game.tokens.append(welcome.resume)

    def outstanding(self) -> int:
        return self.waiting

    def close(self, code: int, reason: str) -> None:
        if self.number % 2:
            self.game.lose(self.number)


class _Framed(_Deaf):
    """A link that takes and gives whole frames."""

    inlet: Callable[[bytes, float], bool] | None = None

    def outlet(self) -> Callable[[bytes], None]:
        return self._send_frame

    def _send_frame(self, message: bytes) -> None:
        assert message[0] == 0x82
        assert len(message) - (2 if message[1] < 126 else 4) == (
            message[1] if message[1] < 126 else int.from_bytes(message[2:4], "big")
        )

    def take(self, data: bytes, now: float) -> bool:
        """Offers the inlet a message in its frame, and sometimes anything. Returns whether it was taken."""
        chunk = data if self.game.rng.random() < 0.02 else frame(data)
        return self.inlet is not None and self.inlet(chunk, now)


class FuzzedGame:
    """A target of the fuzzer: a game with players, each input of which is one client's next message."""

    PLAYERS = 6
    LIFE = 4000
    """Number of messages after which a new game starts, so that few messages reproduce a failure."""

    def __init__(self) -> None:
        self.made = 0
        self._begin()

    def _begin(self) -> None:
        life = self.made // self.LIFE
        self.calm = life % 5 > 1
        scene = fuzzed_scene(aim=life % 2 == 1, behaviours=life % 4 in (0, 1))
        limits = Limits(resume_s=1.0, silence_s=4.0, stalled_s=2.0, hello_s=1.0, edits_per_s=200.0)
        self.rng = random.Random(self.made)
        self.now = 0.0
        self.game = Game(scene, limits=limits, compiled=None if life % 3 else False, rules=_Shooting())
        self.links: dict[int, _Deaf] = {}
        self.tokens = [b""]
        self.sessions: dict[int, Session] = {}

    def lose(self, number: int) -> None:
        session = self.sessions.pop(number, None)
        if session is not None:
            self.game.lost(session, self.now)

    def _open(self, number: int) -> None:
        self.links[number] = link = _Framed(self, number) if number % 3 else _Deaf(self, number)
        self.sessions[number] = self.game.open(link, self.now)

    def __call__(self, data: bytes) -> str:
        self.made += 1
        if self.made % self.LIFE == 0:
            self._begin()
        rng, game = self.rng, self.game
        number = int(rng.random() * self.PLAYERS)
        if number not in self.sessions or self.sessions[number].closed:
            self.lose(number)
            self._open(number)
            if rng.random() < 0.95:
                hello = Hello(messages.VERSION, {}, "Ann", resume=rng.choice(self.tokens[-8:]))  # of any player
                game.receive(self.sessions[number], encode(hello), self.now)
        session = self.sessions[number]
        before = game.counters.kicked
        if not _is_message(data, self.game.scene) and rng.random() < 0.98:
            data = self._plausible()  # malformed messages end the session, so most are replaced
        if not session.entity and rng.random() < 0.9:
            data = encode(Ping(0.0))
        elif self.calm and session.entity and rng.random() < 0.97:
            data = self._expected(self.links[number])
        link = self.links[number]
        if not (isinstance(link, _Framed) and link.take(data, self.now)):
            game.receive(session, data, self.now)
        told = f"{bool(session.entity)} {session.closed} {game.counters.kicked - before}"
        if rng.random() < (0.002 if self.calm else 0.02):
            self.lose(number)
        if rng.random() < (0.002 if self.calm else 0.02) and number in self.links:
            self.links[number].waiting = rng.choice((0, 0, 1 << 20))
        if self.made % 4 == 0:
            self.now += 1 / 32 if rng.random() < 0.999 else 3.0
            game.tick(self.now, self.now + rng.choice((0.0, 0.01)))
            self._check()
        return told

    def _expected(self, link: _Deaf) -> bytes:
        """Returns the inputs that a client sends that does nothing special."""
        rng, tick = self.rng, self.game.world.tick
        n = 1 + (rng.random() < 0.5)
        if not tick - 20 < link.next < tick + 20:
            link.next = tick + 2
        first, link.next = link.next, link.next + n
        move = bytes((rng.randrange(-127, 128) & 255, 0, 0)) + bytes(self.game.scene.input_row_bytes - 3)
        return encode(Inputs(first, tick - 1, move * n))

    def _plausible(self) -> bytes:
        """Returns a message that a client might send now, approximately."""
        rng, tick, size = self.rng, self.game.world.tick, self.game.scene.input_row_bytes
        x, y, z = (rng.randint(-8, 8) for _ in range(3))
        return encode(
            rng.choice(
                (
                    Inputs(max(0, tick + rng.randint(-70, 70)), tick, rng.randbytes(size * rng.randrange(20))),
                    Inputs(tick + 1, tick - rng.randrange(3), rng.randbytes(2 * size)),
                    Held(rng.randint(1, 64), rng.randrange(70)),
                    Command(
                        rng.randrange(COMMAND_MAX) if rng.random() < 0.01 else self.made,
                        tick + rng.randint(-3, 70),
                        rng.choice((tick - 2.5, 1e300, -1e300)),
                        rng.choice(("edit", "shoot")),
                        edits.pack(edits.Edit(x, y, z, rng.randrange(256))),
                    ),
                    Ping(rng.random(), rng.randrange(9)),
                    Resync() if rng.random() < 0.2 else Ping(0.0),
                    Restart(max(0, tick + rng.randint(-70, 70))),
                )
            )
        )

    def _check(self) -> None:
        game, limits, bound = self.game, self.game.limits, bounds(self.game.scene.tick_rate)
        assert game.faults.total == 0
        assert game.counters.rules_failed == 0
        assert len(game.sessions) <= self.PLAYERS
        for player in game.players.values():
            if player.row >= 0 and game.world.tick % 64:
                continue  # looking at its queues would take it off the fast path
            assert len(player.commands) <= limits.commands_waiting_max
            assert len(player.inputs.waiting) <= bound.ahead
            assert all(clamp(input_) == input_ for input_ in player.inputs.waiting.values())
            assert max(len(player.inputs.margins), len(player.inputs.statuses)) <= bound.statuses
            assert len(player.verdicts) <= 32 * limits.messages_per_tick * (1 + limits.stalled_s)
            assert len(player.tokens) <= 2
            assert len(player.outbox) <= limits.outbox_max


def _is_message(data: bytes, scene: Scene) -> bool:
    try:
        decode_from_client(data, scene.input_row_bytes)
    except ProtocolError:
        return False
    return True
