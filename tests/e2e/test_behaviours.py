"""A real server of a game with behaviours: real clients predict them, and `kill -9` loses none of their state."""

import random
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from client_sdk import Client
from client_sdk.events import BehaviourFailed, Corrected, Diverged, Joined, Left
from server.journal.records import replay
from tests.behaving import BUTTONS, CLASSES, Acrobat, Presser, scene
from tests.e2e.processes import START_S, ServerProcess, running, stats
from tests.e2e.test_kills import looked_at
from tests.lengths import contained, long

pytestmark = pytest.mark.e2e

GAME = ("--port", "0", "--game", "tests.behaving:Playground")
CAUSES = {"other entity", "late input", "unknown edit"}


def play(url: str, seconds: float, seed: int) -> None:
    """Plays with two clients that press buttons at random for some seconds."""
    rng, pressers = random.Random(seed), [Presser(), Presser()]
    with ExitStack() as stack:
        clients = [stack.enter_context(Client.connect(url, behaviours=CLASSES)) for _ in pressers]
        joined, until, end = set(), time.monotonic() + START_S, float("inf")
        while (now := time.monotonic()) < min(until, end):
            for client, presser in zip(clients, pressers, strict=True):
                for event in client.poll():
                    assert not isinstance(event, Left | Diverged | BehaviourFailed), event
                    assert not isinstance(event, Corrected) or event.cause in CAUSES, event
                    if isinstance(event, Joined):
                        joined.add(client)
                x, y, bits, _ = presser.next(rng)
                held = {name: bits >> k & 1 for k, name in enumerate(BUTTONS)}
                client.set_input(x / 127, y / 127, buttons=held)
                client.update()
            if len(joined) == len(clients) and end == float("inf"):
                end = now + seconds
            time.sleep(1 / 64)
        assert len(joined) == len(clients)


@pytest.mark.parametrize("kills", [*contained(1), *long(12)])
def test_no_state_of_behaviours_is_lost_in_kills(tmp_path: Path, kills: int) -> None:
    data, expected = tmp_path / "data", None
    for life in range(kills):
        record = tmp_path / f"record-{life}"
        how = {"SOVEREIGN_CHECKPOINT_S": ("0.3", "60")[life % 2]}
        server = ServerProcess(*GAME, "--data", str(data), "--record", str(record), **how)
        try:
            host, port = server.address()
            if expected is not None:
                figures = stats((host, port))
                assert (figures["restored_tick"], figures["restored_hash"]) == expected, life
            play(f"ws://{host}:{port}", 0.6, life)
            server.process.send_signal(signal.SIGKILL)
        finally:
            server.close()
        world, expected = looked_at(data, scene(), tmp_path / "copy", "tests.behaving:Playground")
        assert any(world.scene.templates[row[1]].name == "player" for row in world.states().tolist())
        hashes = {moment.world.tick: moment.world.state_hash().hex() for moment in replay(record, behaviours=CLASSES)}
        assert hashes[expected[0]] == expected[1]


@pytest.mark.slow
def test_a_client_without_the_classes_is_refused_and_leaves_no_player() -> None:
    with running(*GAME) as server:
        host, port = server.address()
        with Client.connect(f"ws://{host}:{port}", behaviours=[Acrobat]) as client:
            until, left = time.monotonic() + START_S, None
            while left is None and time.monotonic() < until:
                client.update()
                left = next((event for event in client.poll() if isinstance(event, Left)), None)
                time.sleep(0.01)
        assert left is not None
        assert "needs the class Shot" in left.reason
        until = time.monotonic() + START_S
        while stats((host, port))["players"] and time.monotonic() < until:
            time.sleep(0.05)
        assert stats((host, port))["players"] == 0
        assert server.end(signal.SIGTERM) == 0
