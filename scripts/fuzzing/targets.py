"""The targets of the fuzzer. A target takes bytes, checks what the product promises about them, and names the outcome.

A broken promise raises `AssertionError`. Any other exception is one that the product should not have raised.
"""

import atexit
import contextlib
import io
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from scripts.fuzzing.fuzzed_game import FuzzedGame, fuzzed_scene
from server.config.options import SettingsError
from server.config.settings import KINDS, Settings, parse
from shared import edits
from shared.bulk import GAP_GOES_ON, HAS_EVENTS, WITHIN
from shared.fields import (
    AIM_ROW_BYTES,
    CLIENT_LIST_MAX,
    CLIENT_MESSAGE_MAX,
    COMMAND_MAX,
    INPUT_ROW_BYTES,
    TICK_MAX,
)
from shared.layout import EDGE_HIGH, NEW_BUTTONS, NEW_MOVE, STOP_X, STOP_Z, TOLD, WHOLE
from shared.messages import (
    CLIENT_KINDS,
    VERSION,
    Announce,
    Bye,
    Command,
    Happened,
    Held,
    Hello,
    Inputs,
    Message,
    Ping,
    Pong,
    Private,
    ProtocolError,
    Refusal,
    Resync,
    Shared,
    Snapshot,
    Terrain,
    Welcome,
    decode,
    decode_from_client,
    decode_from_server,
    encode,
)
from shared.payloads import unpack_value
from shared.snapshot import STATE_HIGH, STATE_LOW, decode_parts

Target = Callable[[bytes], str]
WORDS = re.compile(r"[A-Za-z_.]* ?[A-Za-z]*")
TEMPLATES = 3
EXTRAS = fuzzed_scene(aim=True, behaviours=True).extras

TURNS = bytes([HAS_EVENTS | GAP_GOES_ON | 2, 3, TOLD | NEW_MOVE | NEW_BUTTONS | STOP_X | STOP_Z])
TURNS += bytes([127, 0, 1, EDGE_HIGH | 3, WITHIN | 4, 5, 6, 7]) + bytes([1, 0, 127])
PART = [0, -1, 2, 1, TURNS, b"\1" + bytes(32), bytes(4), 0, bytes(3), [1, {"name": "Ann"}]]
FIELDS = EXTRAS.record(2, 0b10100111, [each.high for each in EXTRAS.columns])
FROM_CLIENT: tuple[Message, ...] = (
    Hello(VERSION, {}, "Ann"),
    Hello(VERSION, {"gravity": bytes(8)}, "", "token", bytes(16)),
    Inputs(5, 3, bytes((127, 0, 1)) * 4),
    Inputs(TICK_MAX - 64, TICK_MAX, bytes(192)),
    Held(1, 3),
    Held(64, TICK_MAX),
    Ping(-0.5, COMMAND_MAX),
    Command(1, 20, 17.25, "edit", edits.pack(edits.Edit(1, 0, 1, 4))),
    Command(2, -1, 1e300, "shoot", b"\x93\x01\x02\xcb" + bytes(8)),
    Resync(),
    Bye(1000, "gone", -1.0),
)
FROM_SERVER: tuple[Message, ...] = (
    Bye(1001, "going down", 2.0),
    Welcome(VERSION, 7, 1, {"name": "flat"}, bytes(16)),
    Snapshot(9, 8, bytes(4), 7, bytes(2), bytes(5), bytes(12), (PART, PART)),
    Snapshot(9, -1, b"", 0, b"", b"", b"", ()),
    Snapshot(9, 8, b"", 0, b"", b"", b"", ([0, 0, 0, 1, b"", b"", b"", 0, b"", [], FIELDS * 2],)),
    Terrain(0, -1, 2, 0, 4, b"\1\2\3\4"),
    Pong(1.5, 17.25),
    Happened(3, "goal", b"\xc0"),
    Announce(3, 7, "dash", b"\xc0"),
    Refusal(1, "not here"),
    Private({"role": "spy"}),
    Shared({"score": [1, None, {"x": 3.0}]}),
)


def said(error: Exception) -> str:
    """Returns the first words of an error, which contain nothing that the peer sent."""
    return WORDS.match(str(error))[0][:24]  # type: ignore[index]  # the pattern also matches an empty text


def client(data: bytes) -> str:
    """Decodes as a server does, for scenes without and with aim."""
    return f"{_client(data, INPUT_ROW_BYTES)} {_client(data, AIM_ROW_BYTES)}"


def _client(data: bytes, row_bytes: int) -> str:
    """Decodes as a server does. The fast decoder must agree with the general one."""
    try:
        message: Message | None = decode_from_client(data, row_bytes)
        told = type(message).__name__
    except ProtocolError as error:
        message, told = None, said(error)
    try:
        judged: Message | None = decode(data, CLIENT_KINDS, CLIENT_MESSAGE_MAX, CLIENT_LIST_MAX, row_bytes)
    except ProtocolError:
        judged = None
    assert message == judged
    if message is not None:
        assert decode_from_client(encode(message), row_bytes) == message
    return told


def server(data: bytes) -> str:
    """Decodes as a client does, with the parts of snapshots."""
    try:
        message = decode_from_server(data)
        if not isinstance(message, Snapshot):
            return type(message).__name__
        parts, states, turns = decode_parts(message.segments, TEMPLATES)
        records = [record for part in parts for record in EXTRAS.decode(part.fields)]
    except ProtocolError as error:
        return said(error)
    assert sum(part.entities for part in parts) == len(states)
    for state in states.tolist():
        assert STATE_LOW[0] <= state[0] <= STATE_HIGH[0]
        assert 0 <= state[1] < TEMPLATES
        assert all(STATE_LOW[6:] <= state[6:])
        assert all(state[6:] <= STATE_HIGH[6:])
    assert all(0 <= events < WHOLE for events in turns[:, 1].tolist())
    for _, values in records:
        assert all(EXTRAS.columns[k].low <= value <= EXTRAS.columns[k].high for k, value in values)
    return f"parts {min(len(parts), 3)} {min(len(states), 3)} {min(len(turns), 3)} {min(len(records), 3)}"


def value(data: bytes) -> str:
    """Decodes the payload of a command or of a game event."""
    try:
        return type(unpack_value(data)).__name__
    except ProtocolError as error:
        return said(error)


def edit(data: bytes) -> str:
    """Decodes the payload of the command that places and removes blocks."""
    found = edits.unpack(data)
    if found is not None:
        assert all(type(part) is int and abs(part) < 1 << 28 for part in found[:3])
        assert 0 <= found.kind <= 255
    return str(found is None)


class Desk:
    """A target for the settings. Its bytes are a file, an environment and flags, separated by 0 bytes."""

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
    "session": (FuzzedGame, tuple(map(encode, FROM_CLIENT)), 38),
    "settings": (Desk, SETTINGS, 2),
}
"""Targets by name: a function that makes the target, its first inputs, and its share of all inputs in thousandths."""
