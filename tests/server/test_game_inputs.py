"""Tests of the inputs in the game API: the hooks of a tick get exactly those that its step uses."""

from typing import Any

import pytest

from client_sdk.core import Core
from server.players.player import Player
from server.rules import Rules
from shared.aim import AIM_MAX, NO_AIM, direction, make_aim
from shared.behaviours import Behaviour, field
from shared.checks import MissingError, SceneError
from shared.inputs import Input, make_input, row
from shared.layout import BUTTONS, MOVE_X, MOVE_Y
from shared.messages import MALFORMED, Inputs
from shared.scene import Scene
from sovereign_netcode.playtest import Link, Match
from tests.tables import Table
from tests.worlds import scene

NAMES = ("jump", "dash", "fire")
EDGES = ("held", "pressed", "released")


def yard(**changes: Any) -> Scene:
    """Returns a scene with three buttons, and a floor around its spawn."""
    fill = [[-30, -30, -1, 30, 30, 0, 1]]
    return scene(fill, **({"buttons": NAMES, "tick_rate": 32, "spawns": [(0.0, 0.0, 0.0)]} | changes))


class Told(Rules):
    """Notes what the hooks learn of each player's buttons, and what the step then used."""

    def __init__(self) -> None:
        self.told: list[tuple[int, int, dict[str, set[str]]]] = []
        self.used: dict[tuple[int, int], tuple[int, int, int]] = {}
        self.aims: list[Any] = []
        self.moves: list[tuple[float, float]] = []
        self.joined: list[bool] = []

    def on_join(self, player: Player) -> None:
        self.joined.append(any(getattr(self.game, edge)(player, name) for edge in EDGES for name in NAMES))

    def on_tick(self) -> None:
        game = self.game
        for entity, player in game.players.items():
            state = game._world.state(entity)
            self.used[game.tick - 1, entity] = state[MOVE_X], state[MOVE_Y], state[BUTTONS]
            told = {edge: {name for name in NAMES if getattr(game, edge)(player, name)} for edge in EDGES}
            assert told == {edge: {name for name in NAMES if getattr(game, edge)(entity, name)} for edge in EDGES}
            self.told.append((game.tick, entity, told))
            self.moves.append(game.move(player))
            if game.scene.aim:
                self.aims.append(game.aim(player))


def prove(rules: Told, made: Scene) -> dict[str, int]:
    """Compares what the hooks learned with the inputs that the steps used. Returns how often each edge occurred."""
    counts = dict.fromkeys(EDGES, 0)
    for (tick, entity, told), move in zip(rules.told, rules.moves, strict=True):
        if (tick, entity) not in rules.used:  # the last tick
            continue
        x, y, now = rules.used[tick, entity]
        before = rules.used[tick - 1, entity][2]
        assert move == (x / 127, y / 127)
        for name in NAMES:
            bit = made.button(name)
            assert (name in told["held"]) == bool(now & bit)
            assert (name in told["pressed"]) == bool(now & ~before & bit)
            assert (name in told["released"]) == bool(before & ~now & bit)
        for edge in EDGES:
            counts[edge] += len(told[edge])
    return counts


@pytest.mark.parametrize("path", [Link(), Link(0.05, jitter_s=0.03, loss=0.05)])
def test_hooks_know_the_inputs_that_the_step_uses(path: Link) -> None:
    """Random buttons over links that make some inputs late, so that substitutes are among them."""
    made = yard()
    rules = Told()
    match = Match(made, seed=7, rules=rules)

    def plays(core: Core, rng: Any) -> Input:
        if rng.random() < 0.3:
            return make_input(rng.uniform(-1, 1), rng.uniform(-1, 1), buttons=rng.randrange(8))
        return core.input

    for _ in range(3):
        match.join(plays, path)
        match.run(0.5)
    match.run(15)
    match.players[0].disconnect()
    match.run(1)
    assert rules.joined == [False] * 3, "a player that joins in this tick has no input yet"
    counts = prove(rules, made)
    assert min(counts.values()) > 200
    assert abs(counts["pressed"] - counts["released"]) <= 9
    if path.loss:
        assert match.game.stats()["inputs_substituted"] > 0


@pytest.mark.parametrize("name", NAMES)
def test_a_press_shorter_than_a_tick_is_one_press(name: str) -> None:
    made = yard()
    rules = Told()
    match = Match(made, seed=3, rules=rules)
    player = match.join(lambda core, _: core.input, Link(0.02))
    match.run(3)
    rules.told.clear()
    for n in range(20):
        match.run(0.15 + n / 300)
        player.core.set_input(Input(), name)
        player.core.set_input(Input())
    match.run(1)
    for edge in EDGES:
        assert [told[edge] for _, _, told in rules.told if told[edge]] == [{name}] * 20


def test_a_release_shorter_than_a_tick_is_not_seen() -> None:
    made = yard()
    rules = Told()
    match = Match(made, seed=3, rules=rules)
    player = match.join(lambda core, _: core.input, Link(0.02))
    match.run(2)
    player.core.set_input(Input(), "fire")
    match.run(1)
    rules.told.clear()
    for _ in range(10):
        match.run(0.1)
        player.core.set_input(Input())
        player.core.set_input(Input(), ["fire"])
    assert all(told == {"held": {"fire"}, "pressed": set(), "released": set()} for _, _, told in rules.told)


def test_substitutes_hold_a_button_and_a_long_silence_releases_it() -> None:
    rules = Told()
    table = Table(rules=rules, buttons=NAMES, tick_rate=32)
    link = table.join()
    link.say(Inputs(table.tick_number + 2, -1, row(make_input(buttons=4))))
    rules.told.clear()
    table.tick(20)
    told = [told for _, _, told in rules.told]
    held = [entry["held"] == {"fire"} for entry in told]
    assert held == [False, *[True] * 11, *[False] * 8], "its own tick, 10 repeated ones, then neutral"
    assert [bool(entry["pressed"]) for entry in told] == [n == 1 for n in range(20)]
    assert [bool(entry["released"]) for entry in told] == [n == 12 for n in range(20)]


class Counter(Behaviour):
    """Counts the presses of a button in a field."""

    templates = ("box",)
    presses = field(bits=16)

    def turn(self, me: Any) -> None:
        if me.pressed("fire"):
            me.presses += 1


class Counts(Rules):
    """Counts the presses of a button, as the rules get them."""

    behaviours = (Counter,)
    presses = 0

    def on_tick(self) -> None:
        self.presses += sum(self.game.pressed(player, "fire") for player in self.game.players.values())


def test_rules_and_behaviours_get_the_same_presses() -> None:
    rules = Counts()
    match = Match(yard(aim=True), seed=9, rules=rules)

    def plays(core: Core, rng: Any) -> Input:
        aim = [rng.uniform(-1, 1) for _ in range(3)]
        return make_input(rng.uniform(-1, 1), 0, buttons=rng.randrange(8), aim=aim)

    player = match.join(plays, Link(0.05, jitter_s=0.03, loss=0.05))
    match.run(12)
    assert rules.presses > 40
    assert match.game.api.field(player.core.entity, "presses") == rules.presses
    assert player.core.stats.divergences == match.game.counters.rules_failed == 0


class Steers(Rules):
    """Steers an entity in some ticks, and notes what the hooks learn of it."""

    def __init__(self, wishes: dict[int, dict[str, Any]]) -> None:
        self.wishes = wishes
        self.told: list[Any] = []

    def on_start(self) -> None:
        self.bot = self.game.spawn("box", (4.0, 4.0, 1.0))
        self.first = self.game.tick

    def on_tick(self) -> None:
        game, n = self.game, self.game.tick - self.first
        if n in self.wishes:
            game.steer(self.bot, 0, 0, **self.wishes[n])
        edges = [getattr(game, edge)(self.bot, "dash") for edge in EDGES]
        self.told.append((*map(int, edges), game.aim(self.bot)))


def test_steered_entities_have_buttons_and_an_aim_until_the_next_call() -> None:
    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    wishes: dict[int, dict[str, Any]] = {
        1: {"buttons": "dash", "aim": up},
        3: {"jump": True},
        4: {"buttons": {"dash": True, "fire": 0}, "aim": (0, 0, -9)},
    }
    rules = Steers(wishes)
    table = Table(rules=rules, buttons=NAMES, aim=True)
    table.tick(7)
    assert rules.told[:4] == [(0, 0, 0, None), (1, 1, 0, up), (1, 0, 0, up), (0, 0, 1, None)]
    assert rules.told[4:] == [(1, 1, 0, down), (1, 0, 0, down), (1, 0, 0, down)]


def test_wrong_arguments_are_named_and_nothing_is_done() -> None:
    table = Table(buttons=NAMES)
    link = table.join()
    game, player = table.game.api, link.session.player
    bot = game.spawn("box", (4.0, 4.0, 1.0))
    assert player is not None
    for ask in (game.held, game.pressed, game.released):
        for button in ("Fire", "", None, 5):
            with pytest.raises(SceneError, match=r"no such button \(there are jump, dash, fire\)"):
                ask(player, button)  # type: ignore[arg-type]
        for who in ("Ann", None, 0, 1.5, True):
            with pytest.raises(SceneError, match=r"^entity = "):
                ask(who, "fire")  # type: ignore[arg-type]
        with pytest.raises(MissingError):
            ask(99, "fire")
    with pytest.raises(SceneError, match=r"^aim: the scene 'test' has no aim"):
        game.aim(player)
    for wrong in ({"buttons": "run"}, {"buttons": 5}, {"aim": (0, 0, 1)}, {"aim": 5}, {"jump": "no"}):
        with pytest.raises(SceneError, match=r"^(button|aim|jump)"):
            game.steer(bot, 1, 0, **wrong)
        assert not game.steered
    with pytest.raises(SceneError, match=r"is a player's"):
        game.steer(player.entity, 1, 0, buttons="fire")


# -- aim over the wire ---------------------------------------------------------------------------------------


def test_an_aim_arrives_as_it_was_sent() -> None:
    made = yard(aim=True)
    rules = Told()
    match = Match(made, seed=5, rules=rules)
    sent: set[Any] = {NO_AIM}

    def plays(core: Core, rng: Any) -> Input:
        aim = make_aim([rng.uniform(-1, 1) for _ in range(3)])
        sent.add(aim)
        return Input(0, 0, 0, aim)

    player = match.join(plays, Link(0.05, jitter_s=0.02))
    match.run(10)
    assert player.core.stats.corrections == 0
    aims = [aim for aim in rules.aims if aim is not None]
    assert len(aims) > 200
    assert set(aims) <= {direction(aim) for aim in sent}
    for aim in aims:
        assert abs(sum(part * part for part in aim) - 1) < 1e-9


@pytest.mark.parametrize("rows", [bytes(3), bytes(6), bytes(8), bytes(10), bytes(12), bytes(9 * 64 + 3), bytes(9 * 65)])
def test_rows_of_another_size_end_the_connection(rows: bytes) -> None:
    table = Table(aim=True)
    link = table.join()
    link.say(Inputs(table.tick_number + 1, -1, rows))
    assert link.closings
    assert link.closings[0][0] == MALFORMED
    assert table.game.counters.malformed == 1


@pytest.mark.parametrize("n", [3, 9, 64, 65])
def test_a_scene_without_aim_takes_as_many_rows_as_before(n: int) -> None:
    table = Table()
    link = table.join()
    link.say(Inputs(table.tick_number + 1, -1, row(make_input(1, 0)) * n))
    assert [code for code, _ in link.closings] == ([] if n <= 64 else [MALFORMED])
    table.tick(2)
    assert n > 64 or table.game.world.state(link.session.entity)[MOVE_X] == 127


def test_an_aim_of_a_cheat_has_the_right_length() -> None:
    rules = Told()
    table = Table(rules=rules, aim=True, buttons=NAMES)
    link = table.join()
    cheats = [(-32768, -32768, -32768), (32767, 32767, -32768), (1, 0, 0), (0, 0, 0), (-32768, 0, 0)]
    packed = b"".join(row(Input(127, 0, 0, aim), aim=True) for aim in cheats)
    link.say(Inputs(table.tick_number + 1, -1, packed))
    rules.aims.clear()
    table.tick(len(cheats))
    third = 1 / 3**0.5
    for aim, wanted in zip(
        rules.aims, [(-third,) * 3, (third, third, -third), (1, 0, 0), None, (-1, 0, 0)], strict=True
    ):
        assert aim == (wanted if wanted is None else pytest.approx(wanted, abs=2 / AIM_MAX))
