"""A lone player is never corrected, whatever the network does, because both sides compute the same."""

import random
from dataclasses import replace

import pytest

from client_sdk.core import Core
from client_sdk.events import Answered, Corrected
from client_sdk.netsim.links import PRESETS
from shared.block_kind import BlockKind
from shared.inputs import JUMP, Input
from shared.scene import Scene, load_scene
from shared.units import BLOCK
from shared.world import World
from sovereign_netcode.playtest import Link, Match, Player
from tests.lengths import contained, long


class Tour:
    """A policy that walks, jumps and presses into walls all over the scene, and records what it has done."""

    def __init__(self) -> None:
        self.cells: set[tuple[int, int]] = set()
        self.pressed = self.jumped = 0
        self._input = Input()

    def __call__(self, core: Core, rng: random.Random) -> Input:
        assert core.prediction is not None
        state = core.prediction.predicted.state(core.entity)
        x, y, vx, vy, vz = state[3], state[4], state[6], state[7], state[8]
        self.cells.add((x // BLOCK, y // BLOCK))
        blocked = (self._input.move_x != 0 and vx == 0) or (self._input.move_y != 0 and vy == 0)
        self.pressed += blocked
        self.jumped += vz > 0
        if x > 51 * BLOCK and y > 51 * BLOCK:  # the pit into the void is near: go back
            self._input = Input(-90, -90)
        elif rng.random() < (0.1 if blocked else 0.02):
            self._input = Input(rng.randint(-127, 127), rng.randint(-127, 127), rng.choice((0, JUMP)))
        return self._input


class Hike(Tour):
    """Does the tour in a world without a pit."""

    def __call__(self, core: Core, rng: random.Random) -> Input:
        assert core.prediction is not None
        state = core.prediction.predicted.state(core.entity)
        self.pressed += (self._input.move_x != 0 and state[6] == 0) or (self._input.move_y != 0 and state[7] == 0)
        self.jumped += state[8] > 0
        if rng.random() < 0.04:
            self._input = Input(rng.randint(-89, 89), rng.randint(-89, 89), rng.choice((0, JUMP)))
        return self._input


def play(scene: str, path: Link, ticks: int, seed: int = 1) -> tuple[Match, Player, Tour]:
    match, tour = Match(load_scene(scene), seed), Tour()
    player = match.join(tour, path)
    match.run_until(lambda: player.core.state == "playing", 20)
    match.run(ticks / match.game.scene.tick_rate)
    return match, player, tour


@pytest.mark.parametrize(
    ("latency_ms", "ticks", "least"),
    [*contained((150, 4_000, 50)), *long(*((latency_ms, 6_000, 100) for latency_ms in (0, 50, 150, 300)))],
)
def test_no_correction_under_latency_and_jitter(latency_ms: int, ticks: int, least: int) -> None:
    path = Link(delay_s=latency_ms / 2000, jitter_s=0.040)
    _, player, tour = play("arena", path, ticks)
    stats = player.core.stats
    assert stats.corrections == 0
    assert stats.resyncs == 0
    assert stats.inputs_sent >= ticks - 20
    assert stats.snapshots >= ticks - 20
    assert len(tour.cells) > least
    assert tour.pressed > least
    assert tour.jumped > least
    assert player.closed is None


def heavy(tick_rate: int = 32) -> Scene:
    """The scene hills with a player that speeds up and slows down, and hardly steers in the air."""
    scene = load_scene("hills")
    player = replace(scene.templates[0], acceleration=20.0, friction=8.0, air_control=0.3, gravity=14.0)
    return replace(scene, templates=(player, *scene.templates[1:]), tick_rate=tick_rate)


@pytest.mark.parametrize(
    ("preset", "tick_rate", "ticks"),
    [
        ("lan", 32, 400), ("far", 20, 300),
        *long(*((preset, 32, 4_000) for preset in PRESETS), ("typical", 60, 2_000)),
    ],
)  # fmt: skip
def test_a_player_with_acceleration_is_corrected_for_late_inputs_only(preset: str, tick_rate: int, ticks: int) -> None:
    match, tour = Match(heavy(tick_rate), 3), Hike()
    player = match.join(tour, PRESETS[preset])
    match.run_until(lambda: player.core.state == "playing", 20)
    late_before = player.core.stats.inputs_late
    match.run(ticks / tick_rate)
    causes = [event.cause for event in player.events if isinstance(event, Corrected)]
    assert set(causes) <= {"late input"}
    if player.core.stats.inputs_late == late_before:
        assert not causes
    assert player.core.stats.divergences == 0
    assert tour.pressed > 0
    assert tour.jumped > 0


@pytest.mark.parametrize("preset", ["typical", *long(*sorted(PRESETS.keys() - {"typical"}))])
def test_a_player_in_water_that_comes_and_goes_is_not_corrected(preset: str) -> None:
    """The spawn points are in water; blocks turn from stone to water and back in the way of the player."""
    fill = [[0, 0, 0, 64, 64, 1, 1], [0, 0, 1, 64, 64, 7, "water"], [20, 20, 1, 24, 44, 3, 1]]
    scene = Scene(
        "pool", size=(2, 2, 1), spawns=((32.0, 32.0, 2.0),), terrain={"generator": "boxes", "fill": fill},
        kinds=(BlockKind("water", 77, solid=False),),
    )  # fmt: skip
    match, tour = Match(scene, 5), Hike()
    player = match.join(tour, PRESETS[preset])
    match.run_until(lambda: player.core.state == "playing", 20)
    rng = random.Random(1)
    for _ in range(40):
        x, y, z = (int(part // 1) for part in match.game.world.position(player.core.entity))
        at = x + rng.randint(-6, 6), y + rng.randint(-6, 6), z + rng.randint(-1, 2)
        if (abs(at[0] - x) > 3 or abs(at[1] - y) > 3) and at[2] > 0:
            match.game.world.set_block(*at, rng.choice((1, 77, 77)))
        match.run(0.25)
    causes = {event.cause for event in player.events if isinstance(event, Corrected)}
    assert causes <= {"late input", "unknown edit"}
    assert player.core.stats.divergences == 0
    assert player.core.prediction is not None
    assert player.core.prediction.confirmed.scene.kind("water") == 77


def test_a_push_by_the_rules_is_one_server_act_and_its_decay_is_predicted() -> None:
    match = Match(heavy(), 3)
    player = match.join(lambda core, rng: Input(127, 0), PRESETS["regional"])
    match.run_until(lambda: player.core.state == "playing", 20)
    match.run(1)
    before = player.core.stats.corrections
    for _ in range(4):
        with match.game.api.turn:
            match.game.api.push(player.core.entity, (-12.0, 5.0, 4.0))
        match.run(2.5)
    causes = [event.cause for event in player.events if isinstance(event, Corrected)]
    assert causes == ["server act"] * 4
    assert player.core.stats.corrections - before == 4
    assert player.core.stats.divergences == 0


def test_the_confirmed_world_is_the_servers_world() -> None:
    match, player, _ = play("arena", Link(), 500)
    assert player.core.prediction is not None
    confirmed = player.core.prediction.confirmed
    hashes = {}
    match.on_tick.append(lambda: hashes.update({match.game.world.tick: match.game.world.state_hash()}))
    match.run(5)
    assert confirmed.tick in hashes
    assert confirmed.state_hash() == hashes[confirmed.tick]


def test_one_seed_is_one_run() -> None:
    hashes = [play("arena", Link(0.05, 0.04), 500, seed)[0].game.world.state_hash() for seed in (1, 1, 2)]
    assert hashes[0] == hashes[1]
    assert hashes[0] != hashes[2]


def test_rolling_back_and_replaying_all_the_time_changes_nothing() -> None:
    match = Match(load_scene("arena"), 4)
    player = match.join(Tour(), Link(0.15, 0.04))
    match.run_until(lambda: player.core.state == "playing", 20)
    prediction = player.core.prediction
    assert prediction is not None
    rehearsed = []

    def rehearse() -> None:
        before = prediction.predicted.state_hash()
        rehearsed.append(prediction.predicted.tick - prediction.confirmed.tick)
        prediction.sync_test()
        assert prediction.predicted.state_hash() == before

    match.on_tick.append(rehearse)
    match.run(30)
    assert player.core.stats.corrections == 0
    assert min(rehearsed) >= 8


def test_a_wall_that_only_the_server_has_corrects_the_client_to_the_bit() -> None:
    match = Match(load_scene("flat"), 1)
    player = match.join(lambda core, rng: Input(127, 0), Link(0.05, 0.01))
    match.run_until(lambda: player.core.state == "playing", 20)
    prediction = player.core.prediction
    assert prediction is not None
    x = int(prediction.predicted.position(player.core.entity)[0]) + 1
    match.game.world.fill((x, 0, 8), (x + 1, 128, 12), 4)
    match.game.world.editing.clear()  # so that no client is sent the wall
    match.run(10)
    stats = player.core.stats
    corrections = [event for event in player.events if isinstance(event, Corrected)]
    assert stats.corrections == len(corrections) > 0
    assert set(corrections[0].fields) == {"x", "vx"}
    assert max(stats.correction_blocks) > 0
    mine = prediction.confirmed.state(player.core.entity)
    assert mine[3] + round(0.3 * BLOCK) == x * BLOCK
    assert match.game.world.state(player.core.entity) == mine
    # Nothing explains it, so it is an alarm. The client has recovered by itself: the wall has been sent.
    assert corrections[0].cause == "nondeterminism"
    assert stats.divergences > 0
    assert prediction.confirmed.blocks.get(x, 70, 9) == 4  # by the resynchronisation
    before = stats.corrections
    match.run(10)
    assert stats.corrections == before


def test_edits_are_predicted_and_undone_where_the_server_refuses() -> None:
    match = Match(load_scene("flat"), 1)
    player = match.join(lambda core, rng: Input(), Link(0.1, 0.01))
    match.run_until(lambda: player.core.state == "playing", 20)
    core, prediction = player.core, player.core.prediction
    assert prediction is not None
    x, y, _ = (int(part) for part in prediction.predicted.position(core.entity))

    def block(world: World, dx: int) -> int | None:
        return world.blocks.get(x + dx, y, 8)

    number = core.edit(x + 2, y, 8, 4)
    far = core.edit(x + 20, y, 8, 4)
    match.run(0.05)
    assert block(prediction.predicted, 2) == 4
    assert block(prediction.confirmed, 2) == 0
    match.run(1)
    assert block(prediction.predicted, 2) == block(prediction.confirmed, 2) == block(match.game.world, 2) == 4
    assert block(prediction.predicted, 20) == 0
    answers = {event.number: event for event in player.events if isinstance(event, Answered)}
    assert answers[number].done
    assert answers[far].verdict == "out of reach"
    # The block is where another player stands, whom this client does not know yet: refused, and undone.
    match.game.world.spawn("player", (x - 2.5, y + 0.5, 8))
    refused = core.edit(x - 3, y, 8, 4)
    match.run(0.04)
    assert block(prediction.predicted, -3) == 4
    match.run(1)
    assert block(prediction.predicted, -3) == block(match.game.world, -3) == 0
    answers = {event.number: event for event in player.events if isinstance(event, Answered)}
    assert answers[refused].verdict == "an entity is in the way"
    assert core.stats.corrections == 0
    assert core.stats.divergences == 0


def ferry() -> Scene:
    """Returns a flat world with a template that carries."""
    return load_scene("flat").with_template(
        "ferry", box_offset=(-2.0, -2.0, 0.0), box_size=(4.0, 4.0, 0.5), walk_speed=0, jump_speed=0,
        gravity=0, carries=True, shown="predicted",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("preset", "ticks"), [*contained(("typical", 600)), *long(*((preset, 3_000) for preset in PRESETS))]
)
def test_every_correction_of_a_player_on_a_moving_platform_has_its_cause(preset: str, ticks: int) -> None:
    """The ferry goes to and fro and up and down; its turns are acts of the server, the ways between are predicted."""
    match = Match(ferry(), 2)
    world = match.game.world
    boat = world.spawn("ferry", (60.0, 60.0, 9.0))
    wishes = random.Random(4)

    def ride(core: Core, rng: random.Random) -> Input:
        return Input(wishes.randint(-40, 40), wishes.randint(-40, 40), 0) if wishes.random() < 0.02 else Input()

    player = match.join(ride, PRESETS[preset])
    match.run_until(lambda: player.core.state == "playing", 20)
    me = player.core.entity
    carried = turns = 0
    ways = [(2, 0, 0), (0, 0, 1.5), (-2, 0, 0), (0, 0, -1.5)]

    def steer() -> None:
        nonlocal carried, turns
        if world.tick % 96 == 0:
            world.set_velocity(boat, ways[world.tick // 96 % 4])
            turns += 1
        x, y, z = world.position(boat)
        if abs(world.position(me)[0] - x) > 1.8 or abs(world.position(me)[1] - y) > 1.8:
            world.place(me, (x, y, z + 0.5))
            match.game.log.note_act(me)
        carried += world.position(me)[2] == z + 0.5

    match.on_tick.append(steer)
    match.run(ticks / 32)
    causes = [event.cause for event in player.events if isinstance(event, Corrected)]
    assert set(causes) <= {"late input", "server act", "other entity"}
    assert causes.count("other entity") <= 2 * turns
    assert player.core.stats.divergences == 0
    assert carried > 0.8 * ticks
