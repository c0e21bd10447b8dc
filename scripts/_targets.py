"""What is fuzzed: each target takes bytes, holds what is promised of them, and tells in a word what came of it.

A promise that is broken is an `AssertionError`; any other exception is one that should not have come out.
"""

import atexit
import contextlib
import io
import random
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from server.game import Game
from server.kinds import SettingsError
from server.limits import Limits
from server.rules import Rules
from server.session import Player, Session
from server.settings import KINDS, Settings, parse
from shared import edits, messages
from shared.messages import (
    AHEAD_MAX,
    CLIENT_KINDS,
    CLIENT_LIST_MAX,
    CLIENT_MESSAGE_MAX,
    COMMAND_MAX,
    FATES_MAX,
    TICK_MAX,
    Bye,
    Command,
    Happened,
    Hello,
    Inputs,
    Message,
    Ping,
    Pong,
    ProtocolError,
    Resync,
    Shared,
    Snapshot,
    Terrain,
    Welcome,
    decode,
    decode_from_client,
    decode_from_server,
    encode,
    unpack_value,
)
from shared.scene import Scene, Template
from shared.snapshot import STATE_HIGH, STATE_LOW, decode_parts

Target = Callable[[bytes], str]
WORDS = re.compile(r"[A-Za-z_.]* ?[A-Za-z]*")
TEMPLATES = 3
WELCOME = 17
KINDS_OF_CLIENTS = {messages.KINDS[kind][0].__name__ for kind in CLIENT_KINDS}

PART = [0, -1, 2, 7, b"\1" + bytes(32), bytes(4), bytes(3), 0, [1, {"name": "Ann"}]]
FROM_CLIENT: tuple[Message, ...] = (
    Hello(1, {}, "Ann"),
    Hello(1, {"gravity": bytes(8)}, "", "token", bytes(16)),
    Inputs(5, 3, bytes((127, 0, 1)) * 4),
    Inputs(TICK_MAX - 64, TICK_MAX, bytes(192)),
    Ping(-0.5, COMMAND_MAX),
    Command(1, 20, 17.25, "edit", edits.pack(edits.Edit(1, 0, 1, 4))),
    Command(2, -1, 1e300, "shoot", b"\x93\x01\x02\xcb" + bytes(8)),
    Resync(),
    Bye(1000, "gone", -1.0),
)
FROM_SERVER: tuple[Message, ...] = (
    Bye(1001, "going down", 2.0),
    Welcome(1, 7, 1, {"name": "flat"}, bytes(16)),
    Snapshot(9, 8, bytes(4), 7, bytes(2), bytes(5), bytes(12), (PART, PART)),
    Snapshot(9, -1, b"", 0, b"", b"", b"", ()),
    Terrain(0, -1, 2, 0, 4, b"\1\2\3\4"),
    Pong(1.5, 17.25),
    Happened(3, "goal", b"\xc0"),
    Shared({"score": [1, None, {"x": 3.0}]}),
)


def said(error: Exception) -> str:
    """How the text of an error begins, without what is a peer's own in it."""
    return WORDS.match(str(error))[0][:24]  # type: ignore[index]  # it matches nothing at least


def client(data: bytes) -> str:
    """What a server receives. The quick way is held against the judge."""
    try:
        message: Message | None = decode_from_client(data)
        told = type(message).__name__
    except ProtocolError as error:
        message, told = None, said(error)
    try:
        judged: Message | None = decode(data, CLIENT_KINDS, CLIENT_MESSAGE_MAX, CLIENT_LIST_MAX)
    except ProtocolError:
        judged = None
    assert message == judged
    if message is not None:
        assert decode_from_client(encode(message)) == message
    return told


def server(data: bytes) -> str:
    """What a client receives, and the parts of snapshots."""
    try:
        message = decode_from_server(data)
        if not isinstance(message, Snapshot):
            return type(message).__name__
        parts, states = decode_parts(message.segments, TEMPLATES)
    except ProtocolError as error:
        return said(error)
    assert sum(part.entities for part in parts) == len(states)
    for state in states.tolist():
        assert STATE_LOW[0] <= state[0] <= STATE_HIGH[0]
        assert 0 <= state[1] < TEMPLATES
        assert all(STATE_LOW[6:] <= state[6:])
        assert all(state[6:] <= STATE_HIGH[6:])
    return f"parts {min(len(parts), 3)} {min(len(states), 3)}"


def value(data: bytes) -> str:
    """The payload of a command, or of what rules tell."""
    try:
        return type(unpack_value(data)).__name__
    except ProtocolError as error:
        return said(error)


def edit(data: bytes) -> str:
    """The payload of the command that places and removes blocks."""
    found = edits.unpack(data)
    if found is not None:
        assert all(type(part) is int and abs(part) < 1 << 28 for part in found[:3])
        assert 0 <= found.kind <= 255
    return str(found is None)


class _Shooting(Rules):
    """Looks into the past for every command."""

    def on_command(self, player: Player, name: str, payload: Any) -> bool | None:
        self.game.rewound(player).ray(self.game.position(player.entity), (1.0, 0.5, -0.25), 16.0)
        self.game.set(player.entity, "last", name)
        self.game.send("heard", [name, self.game.tick])
        return None


class _Deaf:
    """A link; now and then it takes nothing, and it may call back while it is being closed."""

    def __init__(self, house: "House", number: int) -> None:
        self.house, self.number, self.waiting = house, number, 0

    def send(self, message: bytes) -> None:
        assert len(message) <= messages.MESSAGE_MAX
        if message[1] == WELCOME:
            welcome = decode_from_server(message)
            assert isinstance(welcome, Welcome)
            self.house.tokens.append(welcome.resume)

    def outstanding(self) -> int:
        return self.waiting

    def close(self, code: int, reason: str) -> None:
        if self.number % 2:
            self.house.lose(self.number)


class House:
    """A game with players at work; each input is one client's next message."""

    PLAYERS = 6
    LIFE = 4000
    """After so many messages there is a new game, so that each can be had again soon."""

    def __init__(self) -> None:
        self.made = 0
        self._begin()

    def _begin(self) -> None:
        template = Template("person", (-0.3, -0.3, 0), (0.6, 0.6, 1.8), walk_speed=5, jump_speed=8)
        scene = Scene(
            name="fuzz",
            templates=(template,),
            player="person",
            tick_rate=32,
            gravity=16.0,
            origin=(-1, -1, -1),
            size=(2, 2, 2),
            spawns=((0.5, 0.5, 1.0),),
            terrain={"generator": "boxes", "fill": [[-32, -32, 0, 32, 32, 1, 1]]},
        )
        limits = Limits(resume_s=1.0, silence_s=4.0, stalled_s=2.0, hello_s=1.0, edits_per_s=200.0)
        self.rng = random.Random(self.made)
        self.now = 0.0
        self.game = Game(scene, limits=limits, compiled=False, rules=_Shooting())
        self.links: dict[int, _Deaf] = {}
        self.tokens = [b""]
        self.sessions: dict[int, Session] = {}

    def lose(self, number: int) -> None:
        session = self.sessions.pop(number, None)
        if session is not None:
            self.game.lost(session, self.now)

    def _open(self, number: int) -> None:
        self.links[number] = link = _Deaf(self, number)
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
                hello = Hello(messages.VERSION, {}, "Ann", resume=rng.choice(self.tokens[-8:]))  # anybody's
                game.receive(self.sessions[number], encode(hello), self.now)
        session = self.sessions[number]
        before = game.counters.kicked
        if client(data) not in KINDS_OF_CLIENTS and rng.random() < 0.98:
            data = self._plausible()  # what is no message ends the session: of that there is enough
        if not session.entity and rng.random() < 0.9:
            data = encode(Ping(0.0))
        game.receive(session, data, self.now)
        told = f"{bool(session.entity)} {session.closed} {game.counters.kicked - before}"
        if rng.random() < 0.02:
            self.lose(number)
        if rng.random() < 0.02 and number in self.links:
            self.links[number].waiting = rng.choice((0, 0, 1 << 20))
        if self.made % 4 == 0:
            self.now += 1 / 32 if rng.random() < 0.999 else 3.0
            game.tick(self.now, self.now + rng.choice((0.0, 0.01)))
            self._check()
        return told

    def _plausible(self) -> bytes:
        """A message as a client might send it now, more or less."""
        rng, tick = self.rng, self.game.world.tick
        x, y, z = (rng.randint(-8, 8) for _ in range(3))
        return encode(
            rng.choice(
                (
                    Inputs(max(0, tick + rng.randint(-70, 70)), tick, rng.randbytes(3 * rng.randrange(20))),
                    Inputs(tick + 1, tick - rng.randrange(3), rng.randbytes(6)),
                    Command(
                        rng.randrange(COMMAND_MAX) if rng.random() < 0.01 else self.made,
                        tick + rng.randint(-3, 70),
                        rng.choice((tick - 2.5, 1e300, -1e300)),
                        rng.choice(("edit", "shoot")),
                        edits.pack(edits.Edit(x, y, z, rng.randrange(256))),
                    ),
                    Ping(rng.random(), rng.randrange(9)),
                    Resync() if rng.random() < 0.2 else Ping(0.0),
                )
            )
        )

    def _check(self) -> None:
        game, limits = self.game, self.game.limits
        assert game.faults.total == 0
        assert game.counters.rules_failed == 0
        assert len(game.sessions) <= self.PLAYERS
        for player in game.players.values():
            assert len(player.commands) <= limits.commands_waiting_max
            assert len(player.inputs._waiting) <= AHEAD_MAX
            assert max(len(player.inputs.margins), len(player.inputs.fates)) <= FATES_MAX
            assert len(player.verdicts) <= 32 * limits.messages_per_tick * (1 + limits.stalled_s)
            assert len(player.tokens) <= 2
        for session in game.sessions:
            assert len(session.outbox) <= limits.outbox_max + 64


class Desk:
    """The settings: bytes are a file, an environment (after a 0 byte) and flags (after another)."""

    def __init__(self) -> None:
        folder = tempfile.mkdtemp()
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        self._file = Path(folder, "s.toml")

    def __call__(self, data: bytes) -> str:
        file, _, rest = data.partition(b"\0")
        variables, _, flags = rest.partition(b"\0")
        self._file.write_bytes(file)
        environment = dict(
            line.partition("=")[::2] for line in variables.decode(errors="replace").splitlines() if "=" in line
        )
        arguments = [*flags.decode(errors="replace").splitlines(), "--config", str(self._file)]
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                found = parse(arguments, environment)
        except SettingsError as error:
            name = said(error).partition(" ")[0]
            return name if name in KINDS else "another mistake"
        except SystemExit as end:
            return f"ended with {end.code}"
        if isinstance(found, Settings):
            again = found.to_toml()
            self._file.write_text(again, "utf-8")
            same = parse(["--config", str(self._file)], {})
            assert same == found, again
        return type(found).__name__


SETTINGS = tuple(
    file + b"\0" + variables + b"\0" + flags
    for file, variables, flags in (
        (b"\n".join(Settings().to_toml().encode().splitlines()[:12]), b"", b""),
        (
            b"port = 1\nhost = '::1'\n[limits]\njoins_per_s = 1e3\n",
            b"SOVEREIGN_PORT=9000",
            b"--port=80\n--figures\nall",
        ),
        (b"allowed_origins = ['a', \"b\"]", b"SOVEREIGN_ALLOWED_ORIGINS=a,b", b"--loopback-exempt\n--seed=7"),
        (b"auth = 'none'\nhost = '0.0.0.0'", b"SOVEREIGN_RESUME_S=1_0", b"--print-config"),
        (b"", b"SOVEREIGN_LOOPBACK_EXEMPT=no", b"--list-scenes"),
        (b"", b"SOVEREIGN_RESTART_S=nan", b"--help"),
    )
)
VALUES = tuple(message.payload for message in (*FROM_CLIENT, *FROM_SERVER) if isinstance(message, Command | Happened))

TARGETS: dict[str, tuple[Callable[[], Target], tuple[bytes, ...], int]] = {
    "client": (lambda: client, tuple(map(encode, FROM_CLIENT)), 380),
    "server": (lambda: server, tuple(map(encode, FROM_SERVER)), 200),
    "value": (lambda: value, VALUES, 200),
    "edit": (lambda: edit, VALUES, 180),
    "session": (House, tuple(map(encode, FROM_CLIENT)), 38),
    "settings": (Desk, SETTINGS, 2),
}
"""By name: what makes it, the inputs to begin with, and its share of all inputs in thousandths."""
