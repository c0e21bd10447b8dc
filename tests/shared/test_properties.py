"""Properties of every world, however it was made (Hypothesis; the examples are the same in every run).

Mirroring x or y is an exact symmetry, because halves are rounded away from zero. A quarter turn is not, because x moves
before y: at a corner the two worlds may take the two different ways around it (H5, H16). It is exact wherever no tick
moves an entity along both axes; the test covers that case.
"""

from typing import NamedTuple

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.inputs import Input
from shared.layout import FALLING
from shared.scene import Template
from shared.units import BLOCK, SPEED
from shared.world import OverlapError, World
from tests.lengths import examples
from tests.worlds import around, box, build, states, wake_all

SIDE = 5
TICKS = 40
RATES = (20, 30, 32, 60, 64, 128)

# Centred boxes, so that a mirrored or turned one is the same box: a tall one, a wide one, and one that stops nothing.
KINDS = (
    Template("person", (-0.3, -0.3, 0), (0.6, 0.6, 1.8), walk_speed=3, jump_speed=8),
    Template("crate", (-0.5, -0.5, 0), (1, 1, 1)),
    Template("ghost", (-0.3, -0.3, 0), (0.6, 0.6, 1.8), walk_speed=5, jump_speed=5, solid=False),
)


class Actor(NamedTuple):
    """An entity and its inputs: positions in sixteenths of a block, velocities in blocks/s."""

    kind: int
    at: tuple[int, int, int]
    velocity: tuple[float, float, float]
    wishes: list[tuple[int, int, int]]


class Play(NamedTuple):
    """A small world: solid blocks within +-5 of a middle, and its entities."""

    blocks: list[tuple[int, int, int]]
    actors: list[Actor]
    rate: int
    integrator: str
    gravity: float


near = st.integers(-SIDE, SIDE - 1)
speeds = st.sampled_from([0.0, 3.0, -3.0, 7.7, -7.7, 31.9, -31.9, 200.0, -1000.0])
moves = st.sampled_from([0, 127, -127, 60, -33])
actors = st.builds(
    Actor,
    st.integers(0, len(KINDS) - 1),
    st.tuples(
        st.integers(-16 * SIDE, 16 * SIDE), st.integers(-16 * SIDE, 16 * SIDE), st.integers(-16 * SIDE, 16 * SIDE)
    ),
    st.tuples(speeds, speeds, speeds),
    st.lists(st.tuples(moves, moves, st.integers(0, 1)), max_size=4),
)
plays = st.builds(
    Play,
    st.lists(st.tuples(near, near, near), max_size=60),
    st.lists(actors, min_size=1, max_size=6),
    st.sampled_from(RATES),
    st.sampled_from(["mean", "semi"]),
    st.sampled_from([0.0, 16.0, 18.0]),
)

some = settings(
    max_examples=examples(60),
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)
Middle = tuple[int, int, int]


def stage(play: Play, compiled: bool, middle: Middle = (0, 0, 0), **changes: object) -> World:
    """Returns a closed room around a middle with the blocks of a play, and every entity of it that fits in."""
    x, y, z = middle
    fill = [
        [x - 13, y - 13, z - SIDE - 1, x + 13, y + 13, z + 13, 1],
        [x - 12, y - 12, z - SIDE, x + 12, y + 12, z + 12, 0],
    ]
    fill += [[x + i, y + j, z + k, x + i + 1, y + j + 1, z + k + 1, 1] for i, j, k in play.blocks]
    rules: dict[str, object] = {"tick_rate": play.rate, "integrator": play.integrator, "gravity": play.gravity}
    world = build(
        fill, compiled=compiled, templates=KINDS, player="person", **(around(*middle) | rules | changes)
    )  # fmt: skip
    for actor in play.actors:
        spawn(world, actor, middle)
    return world


def spawn(world: World, actor: Actor, middle: Middle = (0, 0, 0)) -> int | None:
    x, y, z = (part / 16 + of for part, of in zip(actor.at, middle, strict=True))
    try:
        return world.spawn(KINDS[actor.kind].name, (x, y, z), actor.velocity)
    except OverlapError:
        return None


def wishes(world: World, play: Play, tick: int) -> dict[int, Input]:
    """Returns the inputs of a tick: every tenth tick, every entity gets another one."""
    if tick % 10:
        return {}
    inputs = {}
    for number, entity in enumerate(world.entities["id"].tolist()):
        script = play.actors[number].wishes
        if tick // 10 < len(script):
            inputs[entity] = Input(*script[tick // 10])
    return inputs


def solid_overlaps(world: World) -> set[tuple[object, object]]:
    """Returns each pair of an entity and a block or solid entity that overlap."""
    boxes = {entity: box(world, entity) for entity in world.entities["id"].tolist()}
    solid = {entity: world.scene.templates[world.state(entity)[1]].solid for entity in boxes}
    found: set[tuple[object, object]] = set()
    for entity, (x0, y0, z0, x1, y1, z1) in boxes.items():
        for z in range(z0 // BLOCK, -(-z1 // BLOCK)):
            for y in range(y0 // BLOCK, -(-y1 // BLOCK)):
                for x in range(x0 // BLOCK, -(-x1 // BLOCK)):
                    if world.blocks.get(x, y, z) not in (0, None):
                        found.add((entity, (x, y, z)))
        for other, (u0, v0, w0, u1, v1, w1) in boxes.items():
            apart = x0 >= u1 or u0 >= x1 or y0 >= v1 or v0 >= y1 or z0 >= w1 or w0 >= z1
            if entity < other and solid[entity] and solid[other] and not apart:
                found.add((entity, other))
    return found


@some
@given(play=plays)
def test_no_entity_enters_an_obstacle(compiled: bool, play: Play) -> None:
    world = stage(play, compiled)
    assert solid_overlaps(world) == set()
    inside: set[tuple[object, object]] = set()
    for tick in range(TICKS):
        if tick == 20:  # terrain over everybody: entities may leave what they are in, and enter nothing else
            world.load_segment((0, 0, 0), world.blocks.segment((0, 0, -1)).reshape(-1).copy())
            inside = solid_overlaps(world)
        world.step(wishes(world, play, tick))
        after = solid_overlaps(world)
        assert after <= inside
        inside = after


@some
@given(play=plays, east=st.sampled_from([1, -1]), north=st.sampled_from([1, -1]))
def test_a_mirrored_world_moves_mirrored(compiled: bool, play: Play, east: int, north: int) -> None:
    def mirror(actor: Actor) -> Actor:
        (x, y, z), (vx, vy, vz) = actor.at, actor.velocity
        script = [(east * mx, north * my, jump) for mx, my, jump in actor.wishes]
        return actor._replace(at=(east * x, north * y, z), velocity=(east * vx, north * vy, vz), wishes=script)

    image = play._replace(
        blocks=[(x if east > 0 else -1 - x, y if north > 0 else -1 - y, z) for x, y, z in play.blocks],
        actors=[mirror(actor) for actor in play.actors],
    )
    worlds = stage(play, compiled), stage(image, compiled)
    for tick in range(TICKS):
        for world, script in zip(worlds, (play, image), strict=True):
            world.step(wishes(world, script, tick))
        for a, b in zip(*map(states, worlds), strict=True):
            entity, kind, flags, x, y, z, vx, vy, vz, *_ = b
            assert a[:9] == (entity, kind, flags, east * x, north * y, z, east * vx, north * vy, vz)


@some
@given(play=plays, quarter=st.booleans())
def test_a_world_turned_by_a_quarter_moves_turned(compiled: bool, play: Play, quarter: bool) -> None:
    """One entity moves along one axis and falls. It cuts no corner, so the order of axes cannot show."""
    actor = play.actors[0]
    axis = int(quarter)
    script = [(m, 0, jump) if axis == 0 else (0, m, jump) for m, _, jump in actor.wishes]
    speed = (actor.velocity[0], 0.0, actor.velocity[2]) if axis == 0 else (0.0, actor.velocity[0], actor.velocity[2])
    play = play._replace(actors=[actor._replace(wishes=script, velocity=speed)])
    turned = play._replace(
        blocks=[(-1 - y, x, z) for x, y, z in play.blocks],
        actors=[
            a._replace(
                at=(-a.at[1], a.at[0], a.at[2]),
                velocity=(-a.velocity[1], a.velocity[0], a.velocity[2]),
                wishes=[(-my, mx, jump) for mx, my, jump in a.wishes],
            )
            for a in play.actors
        ],
    )
    worlds = stage(play, compiled), stage(turned, compiled)
    for tick in range(TICKS):
        for world, part in zip(worlds, (play, turned), strict=True):
            world.step(wishes(world, part, tick))
        for a, b in zip(*map(states, worlds), strict=True):
            x, y, z, vx, vy, vz = a[3:9]
            assert b[:9] == (*a[:3], -y, x, z, -vy, vx, vz)


@some
@given(
    play=plays,
    shift=st.tuples(*[st.sampled_from([0, 1, -1, 7, 31, 32, -33, 1000, 10**6, -(10**7), (1 << 27) - 50])] * 3),
)
def test_translation_by_whole_blocks_changes_nothing(compiled: bool, play: Play, shift: Middle) -> None:
    """This holds across segment borders, too, and at the far ends of the range."""
    worlds = stage(play, compiled), stage(play, compiled, shift)
    x0, y0, z0 = (part * BLOCK for part in shift)
    for tick in range(TICKS):
        for world in worlds:
            world.step(wishes(world, play, tick))
        for a, b in zip(*map(states, worlds), strict=True):
            entity, kind, flags, x, y, z, *rest = b
            assert a == (entity, kind, flags, x - x0, y - y0, z - z0, *rest)


@some
@given(play=plays, data=st.data())
def test_ids_decide_and_neither_order_of_entry_nor_rows(compiled: bool, play: Play, data: st.DataObject) -> None:
    """The hash is the same with inputs in another order, with reused rows, and with blocks entered in another order."""
    world = stage(play, compiled)
    empty = stage(play._replace(actors=[], blocks=[]), compiled)
    for number in range(data.draw(st.integers(0, 9))):
        empty.spawn("ghost", (8, 8, number))
    for entity in data.draw(st.permutations(empty.entities["id"].tolist())):
        empty.remove(entity)
        if data.draw(st.booleans()):
            empty.step()
    for x, y, z in data.draw(st.permutations(play.blocks)):
        empty.set_block(x, y, z, 1)
    empty.put(data.draw(st.permutations(states(world))))
    empty.rebase(world.tick)
    for tick in range(TICKS):
        assert empty.state_hash() == world.state_hash()
        inputs = wishes(world, play, tick)
        world.step(inputs)
        empty.step(dict(reversed(inputs.items())))


@some
@given(play=plays, data=st.data())
def test_sleep_does_not_show(compiled: bool, play: Play, data: st.DataObject) -> None:
    """A world whose entities are all woken in every tick has the same hash, with edits, removals and placements."""
    world, restless = stage(play, compiled), stage(play, compiled)
    for tick in range(TICKS):
        event = data.draw(st.sampled_from(["", "", "", "edit", "remove", "place"]))
        entities = world.entities["id"].tolist()
        chosen = data.draw(st.sampled_from(entities)) if entities else 0
        spot = data.draw(st.tuples(near, near, near))
        if event == "edit":
            for each in (world, restless):
                each.fill(spot, (spot[0] + 2, spot[1] + 2, spot[2] + 2), 0)
        elif event == "remove" and entities:
            world.remove(chosen)
            restless.remove(chosen)
        elif event == "place" and entities:
            try:
                world.place(chosen, spot)
            except OverlapError:
                pass
            else:
                restless.place(chosen, spot)
        wake_all(restless)
        assert restless.awake_count >= len(restless)
        inputs = {e: w for e, w in wishes(world, play, tick).items() if len(world) == len(play.actors)}
        world.step(inputs)
        restless.step(inputs)
        assert world.state_hash() == restless.state_hash()


@some
@given(play=plays)
def test_nothing_moves_further_than_its_speed(compiled: bool, play: Play) -> None:
    """An entity moves at most by its velocity per axis and tick (for z, the faster of the old and the new one), rounded
    once."""
    world = stage(play, compiled)
    for tick in range(TICKS):
        before = {state[0]: state for state in states(world)}
        world.step(wishes(world, play, tick))
        for entity, kind, _, *now in states(world):
            old = before[entity]
            template = KINDS[kind]
            for k in range(3):
                speed = abs(old[6 + k])
                if k < 2 and template.walk_speed:
                    speed = abs(walk(template, world.state(entity)[9 + k]))
                elif k == 2 and play.gravity:
                    fall = round(play.gravity / play.rate * SPEED)
                    starts = [old[8], round(template.jump_speed * SPEED)] if world.state(entity)[11] & 1 else [old[8]]
                    speed = max(abs(v) for start in starts for v in (start, start - fall))
                limit = (2 * speed * BLOCK // SPEED + play.rate) // (2 * play.rate)
                assert abs(now[k] - old[3 + k]) <= limit


def walk(template: Template, move: int) -> int:
    return round(template.walk_speed * SPEED * move / 127)


@some
@given(play=plays, rate=st.sampled_from([32, 64, 128]))
def test_energy_never_rises_under_the_default_integrator(compiled: bool, play: Play, rate: int) -> None:
    """v^2 / 2 + g z of a ballistic entity, in exact whole numbers, at tick rates whose ticks are not rounded.

    Only blocks stop the entity here. Landing on a moving entity would take nothing from that entity, but would leave x
    and y as free.
    """
    play = play._replace(
        actors=[actor._replace(kind=1) for actor in play.actors], gravity=16.0, integrator="mean", rate=rate
    )
    world = stage(play, compiled, terminal_speed=1024.0)
    g = 16 * BLOCK

    def energy(state: tuple[int, ...]) -> int:
        """Returns twice the energy, in units of (2^-24 block) (2^-24 block) / s^2."""
        square = sum((part * (BLOCK // SPEED)) ** 2 for part in state[6:9])
        return square + 2 * g * state[5]

    energies = {state[0]: energy(state) for state in states(world)}
    for _ in range(TICKS):
        world.step()
        for state in states(world):
            assert energy(state) <= energies[state[0]]
            energies[state[0]] = energy(state)


@some
@given(play=plays, at=st.integers(0, TICKS - 1), data=st.data())
def test_a_copy_or_restore_at_any_tick_goes_on_alike(compiled: bool, play: Play, at: int, data: st.DataObject) -> None:
    """The other world has gone another way before: with other inputs, other entities and other blocks."""
    world = stage(play, compiled)
    other = stage(play._replace(actors=play.actors[::-1]), compiled)
    for tick in range(at):
        world.step(wishes(world, play, tick))
        other.step({})
    if data.draw(st.booleans()) and len(other):
        other.remove(data.draw(st.sampled_from(other.entities["id"].tolist())))
    other.fill((-3, -3, -SIDE - 1), (3, 3, 0), 0)
    for number in range(data.draw(st.sampled_from([0, 1, 30]))):
        other.spawn("ghost", (number % 5 - 11, 9, number // 5))
    other.restore(world)
    copied = world.copy()
    for tick in range(at, TICKS):
        inputs = wishes(world, play, tick)
        for each in (world, other, copied):
            each.step(inputs)
        assert world.state_hash() == other.state_hash() == copied.state_hash()


@some
@given(play=plays)
def test_flags_say_what_they_mean(compiled: bool, play: Play) -> None:
    """A sleeper has no velocity and no flag, and is supported if there is gravity. A further turn changes nothing."""
    world = stage(play, compiled)
    for tick in range(TICKS):
        world.step(wishes(world, play, tick))
        for entity in world.entities["id"].tolist():
            state = world.state(entity)
            if not world.awake(entity):
                assert state[2] & FALLING == 0
                assert state[6:9] == (0, 0, 0)
                assert state[11] == 0 or not play.gravity or not KINDS[state[1]].jump_speed
