"""Hard cases of the air: jumps, falls, speed, flights and their energy (H8, H10 to H13, H27 to H29).

The expected values are closed forms in exact rationals: tick h, gravity g, jump speed v0.
"""

import math
from fractions import Fraction

import pytest

from shared.scene import Template
from shared.units import BLOCK, SPEED
from shared.world import World
from tests.worlds import JUMP, TEMPLATES, build, floor, high, steps

RATES = (20, 30, 32, 60, 64, 128)
# With these, every tick of the rates above moves by whole grid steps, so no flight is rounded.
EXACT_GRAVITY, EXACT_JUMP = Fraction(225, 16), Fraction(15, 2)


def flyer(compiled: bool, integrator: str, rate: int, gravity: Fraction, jump: Fraction) -> tuple[World, int]:
    """Returns a world and an entity on a floor at z = 0 that presses jump in the next tick only."""
    templates = (Template("flyer", (0, 0, 0), (1, 1, 1), walk_speed=3, jump_speed=float(jump)),)
    world = build(
        [floor()], compiled=compiled, integrator=integrator, tick_rate=rate, gravity=float(gravity),
        templates=templates, player="flyer", terminal_speed=1024,
    )  # fmt: skip
    return world, world.spawn("flyer", (0, 0, 0))


def height(world: World, entity: int) -> Fraction:
    return Fraction(world.state(entity)[5], BLOCK)


def test_h8_a_jump_under_a_ceiling(compiled: bool, integrator: str) -> None:
    world = build([floor(), [-9, -9, 2, 9, 9, 3, 1]], compiled=compiled, integrator=integrator)
    entity = world.spawn("box", (0, 0, 0))
    world.step({entity: JUMP})
    track = []
    for _ in range(64):
        world.step({entity: JUMP._replace(buttons=0)})
        track.append((high(world, entity)[2], world.velocity(entity)[2], world.falling(entity)))
        if world.position(entity)[2] == 0:
            break
    hit = next(entry for entry in track if entry[1] <= 0)
    assert hit == (2, 0, True)
    assert max(entry[0] for entry in track) == 2
    assert track[-1][0] == 7 / 4
    steps(world, 2)
    assert world.position(entity) == (0, 0, 0)
    assert not world.awake(entity)


@pytest.mark.parametrize(("integrator", "apex", "landing"), [("semi", 2 - 1 / 16, 63), ("mean", 2, 64)])
def test_h10_a_jump_from_rest(compiled: bool, integrator: str, apex: float, landing: int) -> None:
    world = build([floor()], compiled=compiled, integrator=integrator)
    entity = world.spawn("box", (0, 0, 0))
    world.step({entity: JUMP})
    track = [world.position(entity)[2]]
    while track[-1] > 0:
        world.step({entity: JUMP._replace(buttons=0)})
        track.append(world.position(entity)[2])
    assert max(track) == apex
    assert len(track) == landing
    assert track[-1] == 0


@pytest.mark.parametrize("rate", RATES)
def test_h10_apex_and_landing_by_the_closed_forms(compiled: bool, integrator: str, rate: int) -> None:
    g, v0, h = EXACT_GRAVITY, EXACT_JUMP, Fraction(1, rate)
    world, entity = flyer(compiled, integrator, rate, g, v0)
    world.step({entity: JUMP})
    track = [height(world, entity)]
    while track[-1] > 0:
        world.step({entity: JUMP._replace(buttons=0)})
        track.append(height(world, entity))
    if integrator == "semi":
        expected = [v0 * h * n - g * h * h * n * (n + 1) / 2 for n in range(1, len(track) + 1)]
        landing = math.ceil(2 * v0 / (g * h)) - 1
    else:
        expected = [v0 * h * n - g * (h * n) ** 2 / 2 for n in range(1, len(track) + 1)]
        landing = math.ceil(2 * v0 / (g * h))
    assert track[:-1] == expected[:-1]
    assert track[-1] == max(expected[-1], 0)
    assert len(track) == landing


@pytest.mark.parametrize(("integrator", "fallen"), [("semi", 56.125), ("mean", 56)])
def test_h11_a_fall_of_256_ticks(compiled: bool, integrator: str, fallen: float) -> None:
    world = build(compiled=compiled, integrator=integrator, size=(2, 2, 4))
    entity = world.spawn("box", (0.25, 0.5, 90))
    steps(world, 256)
    assert world.velocity(entity) == (0, 0, -16)
    assert world.position(entity) == (0.25, 0.5, 90 - fallen)


def test_h11_thrown_down_faster_than_the_terminal_speed(compiled: bool) -> None:
    """v' = max(v - g dt, -v_t): the terminal speed holds from the first tick of the flight."""
    world = build(compiled=compiled, integrator="semi")
    entity = world.spawn("stone", (0, 0, 20), (0, 0, -100))
    world.step()
    assert world.velocity(entity)[2] == -16
    assert world.position(entity)[2] == 20 - 16 / 64


def test_h12_an_apex_with_no_velocity(compiled: bool, integrator: str) -> None:
    world = build([floor()], compiled=compiled, integrator=integrator)
    entity = world.spawn("box", (0, 0, 0))
    world.step({entity: JUMP})
    steps(world, 31, {entity: JUMP._replace(buttons=0)})
    assert world.velocity(entity) == (0, 0, 0)
    assert world.awake(entity)
    assert world.falling(entity)
    apex = world.position(entity)[2]
    world.step()
    assert world.velocity(entity)[2] == -16 / 64
    assert world.position(entity)[2] < apex


@pytest.mark.parametrize("speed", [96, 104, 800, 1024])
@pytest.mark.parametrize("rate", [20, 64])
@pytest.mark.parametrize("axis", range(3))
def test_h13_no_speed_tunnels_a_wall_of_one_block(compiled: bool, speed: int, rate: int, axis: int) -> None:
    for sign in (1, -1):
        low, top = [-20, -20, -20], [20, 20, 20]
        low[axis], top[axis] = (5, 6) if sign > 0 else (-6, -5)
        world = build([[*low, *top, 1]], compiled=compiled, gravity=0, tick_rate=rate, entity_collision=False)
        speeds = [0.0, 0.0, 0.0]
        speeds[axis] = sign * speed
        for start in (-0.3, 0.0, 1.1):
            entity = world.spawn("stone", (start, start, start), (speeds[0], speeds[1], speeds[2]))
            steps(world, rate)
            face = high(world, entity)[axis] if sign > 0 else world.position(entity)[axis]
            assert face == 5 * sign
            assert world.velocity(entity) == (0, 0, 0)


def test_h27_one_flight_at_six_tick_rates(compiled: bool) -> None:
    """Positions at equal times are equal, and the flight lands at its start: the mean of velocities is exact for a
    parabola."""
    tracks = []
    for rate in RATES:
        world, entity = flyer(compiled, "mean", rate, EXACT_GRAVITY, EXACT_JUMP)
        track = []
        world.step({entity: JUMP})
        steps(world, rate // 2 - 1, {entity: JUMP._replace(buttons=0)})
        for _ in range(2):
            track.append((height(world, entity), Fraction(world.state(entity)[8], SPEED)))
            steps(world, rate // 2)
        tracks.append(track)
        assert track[0] == (EXACT_JUMP / 2 - EXACT_GRAVITY / 8, EXACT_JUMP - EXACT_GRAVITY / 2)
    assert tracks.count(tracks[0]) == len(RATES)


@pytest.mark.parametrize("rate", RATES)
def test_h27_ordinary_numbers_round_by_at_most_half_a_step_a_tick(compiled: bool, rate: int) -> None:
    """With g = 18 and v0 = 8, the path at 32, 64 and 128 Hz is exactly the parabola; at other rates it is within the
    rounding of the model."""
    world, entity = flyer(compiled, "mean", rate, Fraction(18), Fraction(8))
    world.step({entity: JUMP})
    rounded = Fraction(round(Fraction(18) / rate * SPEED), SPEED)
    for n in range(1, int(0.8 * rate)):
        t = Fraction(n, rate)
        parabola = 8 * t - rounded * rate * t * t / 2
        assert abs(height(world, entity) - parabola) * BLOCK <= (0 if 128 % rate == 0 else Fraction(n, 2))
        world.step({entity: JUMP._replace(buttons=0)})
    assert 128 % rate or rounded * rate == 18


@pytest.mark.parametrize("rate", RATES)
def test_h28_position_error_of_a_fall(compiled: bool, integrator: str, rate: int) -> None:
    """The error is zero with the mean, and -g h t / 2 with the integrator "semi"."""
    world = build(
        compiled=compiled, integrator=integrator, tick_rate=rate, gravity=float(EXACT_GRAVITY), terminal_speed=1024,
        size=(2, 2, 4), templates=TEMPLATES,
    )  # fmt: skip
    entity = world.spawn("stone", (0, 0, 90), (1, 0, 0))
    for n in range(1, 2 * rate + 1):
        world.step()
        t, h = Fraction(n, rate), Fraction(1, rate)
        error = -EXACT_GRAVITY * h * t / 2 if integrator == "semi" else 0
        assert height(world, entity) == 90 - EXACT_GRAVITY * t * t / 2 + error


@pytest.mark.parametrize("rate", RATES)
def test_h29_the_energy_of_a_drop_never_rises(compiled: bool, rate: int) -> None:
    """Mean: v^2 / 2 + g z is constant in flight, to the bit. Semi: it falls by (g h)^2 / 2 a tick."""
    for integrator in ("mean", "semi"):
        world, entity = flyer(compiled, integrator, rate, EXACT_GRAVITY, EXACT_JUMP)
        world.place(entity, (0, 0, 16))
        g, h = EXACT_GRAVITY, Fraction(1, rate)
        energies = [g * 16]
        while world.position(entity)[2] > 0:
            world.step()
            energies.append(Fraction(world.state(entity)[8], SPEED) ** 2 / 2 + g * height(world, entity))
        flight = range(len(energies) - 1)
        lost = [0 if integrator == "mean" else (g * h) ** 2 / 2 * n for n in flight]
        assert energies[:-1] == [g * 16 - part for part in lost]
        assert energies[-1] <= energies[-2]
