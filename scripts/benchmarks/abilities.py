"""A dash as a behaviour and as a command, in one game: how soon its player sees it, corrections, and bytes.

Both games change the template of a player to a faster one for some ticks. Players wander on the meadow, in simulated
time at 60 frames a second, and press the button about every three seconds.
"""

import random
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from client_sdk.core import Core
from server.players.player import Player
from server.rules import Rules
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.inputs import Input, make_input
from shared.scene import Scene, load_scene
from sovereign_netcode.playtest import Link, Match, wander

RTTS_MS = (50, 150, 300)
FRAME_S = 1 / 60
DASH_TICKS, REST_TICKS = 8, 48
EVERY_FRAMES = 180
"""Average number of frames between two dashes, more than `REST_TICKS` ticks take."""


REPLAY_RTT_S, REPLAYS = 0.3, 300
"""Round trip in seconds at which about ten ticks are predicted, and number of replays in a round."""


class Dash(Behaviour):
    """The dash as a behaviour."""

    templates = ("player", "dashing")
    ready_at = field(bits=32)
    ends_at = field(bits=32)

    def turn(self, me: Body) -> None:
        if me.pressed("dash") and me.tick >= me.ready_at:
            me.ends_at, me.ready_at = me.tick + DASH_TICKS, me.tick + REST_TICKS
            me.become("dashing")
            me.wake(me.ends_at)
        elif me.template == "dashing" and me.tick >= me.ends_at:
            me.become("player")


class Predicted(Rules):
    """The game with the behaviour."""

    behaviours: Sequence[type[Behaviour]] = (Dash,)

    def prepare(self, scene: Scene) -> Scene:
        return scene.with_buttons("dash").with_template("dashing", walk_speed=14.0)


class Commanded(Predicted):
    """The game with a command, which waits for the server."""

    behaviours = ()

    def __init__(self) -> None:
        self._begun: dict[int, int] = {}

    def on_command(self, player: Player, name: str, payload: Any) -> bool | None:
        begun = self._begun.get(player.entity, -REST_TICKS)
        if self.game.tick < begun + REST_TICKS:
            return False
        self._begun[player.entity] = self.game.tick
        self.game.change(player.entity, "dashing")
        return True

    def on_tick(self) -> None:
        for entity in self.game.entities("dashing"):
            if self.game.tick >= self._begun[entity] + DASH_TICKS:
                self.game.change(entity, "player")


class Program:
    """A player's program: it calls the core once per frame, and measures how soon a dash is in the view.

    Args:
        core: the player's core.
        commands: whether the dash is a command.
        seed: source of everything random.
    """

    def __init__(self, core: Core, commands: bool, seed: int) -> None:
        self.responses: list[int] = []
        """Number of frames from each press to the first frame that shows the dash; 1 is the next frame."""
        self._core, self._commands, self._random = core, commands, random.Random(seed)
        self._waits: int | None = None
        self._next = EVERY_FRAMES

    def __getattr__(self, name: str) -> Any:
        return getattr(self._core, name)

    def update(self, now: float) -> None:
        """Runs a frame: takes the input, predicts, and looks at the view."""
        core = self._core
        core.update(now)
        me = core.view(now).me
        if core.state != "playing" or me is None:
            return
        if self._waits is not None:
            self._waits += 1
            if me.template == "dashing":
                self.responses.append(self._waits)
                self._waits = None
        self._next -= 1
        if self._next <= 0 and self._waits is None and me.template == "player" and any(core.input[:2]):
            self._next = self._random.randrange(EVERY_FRAMES * 3 // 4, EVERY_FRAMES * 5 // 4)
            self._waits = 0
            if self._commands:
                core.command("dash")
            else:  # down and up again within a frame
                held = core.input
                core.set_input(held, ("dash",))
                core.set_input(held)


def run(commands: bool, rtt_ms: float, players: int, seconds: float, seed: int) -> dict[str, Any]:
    """Plays one game. Returns its figures.

    Args:
        commands: whether the dash is a command.
        rtt_ms: round trip in milliseconds.
        players: number of players.
        seconds: length in simulated seconds.
        seed: source of everything random.
    """
    rules = Commanded() if commands else Predicted()
    match = Match(load_scene("meadow"), seed, rules=rules)
    programs = []
    for number in range(players):
        core = Core(f"player {number}", behaviours=rules.behaviours)
        core.port = program = Program(core, commands, seed * 1000 + number)
        match.join(_walks, Link(rtt_ms / 2000), core).frame_s = FRAME_S
        programs.append(program)
    match.run(5)
    before = [(each.core.stats.bytes_down, each.core.stats.bytes_up) for each in match.players]
    causes = Counter[str]()
    for player in match.players:
        causes.subtract(player.core.stats.corrections_by_cause)
    match.run(seconds)
    for player in match.players:
        causes.update(player.core.stats.corrections_by_cause)
    responses = sorted(frames for program in programs for frames in program.responses)
    down, up = (
        sum(now - old[k] for now, old in zip(totals, before, strict=True)) / players / seconds
        for k, totals in enumerate(
            ([p.core.stats.bytes_down for p in match.players], [p.core.stats.bytes_up for p in match.players])
        )
    )
    return {
        "way": "command" if commands else "behaviour",
        "rtt_ms": rtt_ms,
        "dashes": len(responses),
        "frames": statistics.median(responses),
        "frames_p95": responses[len(responses) * 95 // 100],
        "corrections_per_min": sum(causes.values()) / players / (seconds / 60),
        "causes": {cause: count for cause, count in causes.items() if count},
        "bytes_down_per_s": down,
        "bytes_up_per_s": up,
    }


def replay_us(commands: bool, rounds: int, seed: int) -> list[float]:
    """Returns the time of a replay of a lone player, in microseconds for 10 ticks: the median of each round.

    Args:
        commands: whether the game is the one without behaviours.
        rounds: number of rounds, of `REPLAYS` replays each.
        seed: source of everything random.
    """
    rules = Commanded() if commands else Predicted()
    match = Match(load_scene("meadow"), seed, rules=rules)
    core = Core("lone", behaviours=rules.behaviours)
    match.join(_walks, Link(REPLAY_RTT_S / 2), core)
    match.run(8)
    prediction = core.prediction
    assert prediction is not None
    ticks = prediction.predicted.tick - prediction.confirmed.tick
    medians = []
    for _ in range(rounds):
        samples = []
        for _ in range(REPLAYS):
            begun = time.perf_counter()
            prediction.replay(prediction.predicted.tick)
            samples.append(time.perf_counter() - begun)
        medians.append(statistics.median(samples) * 1e6 * 10 / ticks)
    return medians


def _walks(core: Core, rng: random.Random) -> Input:
    """Wanders, like `playtest.wander`, but always walks."""
    made = wander(core, rng)
    return made if any(made[:2]) else make_input(1, 0)
