"""A world and the oracle under one random script, compared bit for bit after every tick.

A seed decides everything: rules, terrain, entities, events. `Twins(seed).run()` raises `AssertionError` at the first
difference, with the seed and the tick in the message.
"""

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from shared.blocks import Kinds, segment_of
from shared.inputs import Input, clamp
from shared.layout import FALLING
from shared.scene import Scene, Template
from shared.units import BLOCK, RANGE_BLOCKS, SEGMENT, SPEED
from shared.world import OverlapError, World
from tests.oracle import Body, Kind, Oracle, nearest

RATES = (20, 30, 32, 60, 64, 128)
SPEEDS = (0.0, 0.5, 3.0, 8.0, 17.3, 96.0, 1024.0)
FAR = (0, 0, 10**6, -(10**6), 10**7, -(10**7), RANGE_BLOCKS - 4096, 4096 - RANGE_BLOCKS)
GRID = Fraction(1, BLOCK)


class Twins:
    """One seeded run.

    Args:
        seed: seed of the whole run.
        compiled: whether the world runs the compiled kernel.
        bodies: maximum number of entities at the start.
        ticks: maximum number of ticks.
    """

    def __init__(self, seed: int, *, compiled: bool, bodies: int = 10, ticks: int = 30) -> None:
        self.seed = seed
        self.random = random.Random(seed)
        self.options = random.Random(f"options {seed}")
        """Chance for what was added later, so that a seed of old makes the world of old."""
        self.ticks = self.random.randint(ticks // 2, ticks)
        r = self.random
        self.center = [r.choice(FAR) // SEGMENT * SEGMENT for _ in range(3)]
        self.scene = self._scene()
        self.world = World(self.scene, compiled=compiled)
        self.oracle = Oracle(
            [_kind(template) for template in self.scene.templates],
            rate=self.scene.tick_rate,
            gravity=Fraction(self.scene.gravity),
            terminal=Fraction(self.scene.terminal_speed),
            mean=self.scene.integrator == "mean",
            pairs=self.scene.entity_collision,
            lowest=self.scene.origin[2] * SEGMENT,
        )
        self.span = r.choice((3, 5, 8))
        self._terrain()
        wanted = r.randint(1, bodies)
        for _ in range(3 * wanted):
            if len(self.oracle.bodies) < wanted:
                self._spawn()

    def run(self) -> None:
        """Runs the script. Raises an `AssertionError` at the first difference."""
        try:
            for _ in range(self.ticks):
                for _ in range(self.random.choice((0, 0, 0, 1, 3))):
                    happen = self.random.choice(EVENTS)
                    happen(self)
                self._step()
        except AssertionError as error:
            raise AssertionError(f"seed {self.seed}, tick {self.world.tick}: {error}") from error

    # -- the world -----------------------------------------------------------------------------------------

    def _scene(self) -> Scene:
        r = self.random
        templates = [Template("player", walk_speed=3.0, jump_speed=8.0)]
        for number in range(r.randint(1, 4)):
            size = [r.choice((0.6, 1.0, 1.8, 5 / 8, 7 / 4, 2.0, r.uniform(0.05, 3.0))) for _ in range(3)]
            templates.append(
                Template(
                    f"kind {number}",
                    (r.choice((0.0, -0.3, -0.5, r.uniform(-3, 3))), r.choice((0.0, -0.5, 2.0)), r.choice((0.0, -1.0))),
                    (size[0], size[1] * r.choice((1, -1)), size[2] * r.choice((1, 1, -1))),
                    walk_speed=r.choice((0.0, 3.0, 2.7, 64.0)),
                    jump_speed=r.choice((0.0, 8.0, 5.3)),
                    solid=r.random() < 0.8,
                )
            )
        if self.options.random() < 0.6:
            templates = [replace(template, **self._motion(template.walk_speed)) for template in templates]
        return Scene(
            "twins",
            tuple(templates),
            tick_rate=r.choice(RATES),
            gravity=r.choice((0.0, 18.0, 16.0, 18.0, r.uniform(1, 100))),
            terminal_speed=r.choice((16.0, 16.0, 3.3, 200.0)),
            integrator=r.choice(("mean", "semi")),
            entity_collision=r.random() < 0.8,
            origin=(0, 0, self.center[2] // SEGMENT - r.choice((0, 1, 1))),
        )

    def _motion(self, walk_speed: float) -> dict[str, Any]:
        """Options of a template's motion."""
        o = self.options
        accelerations = (0.5, 7.0, 30.0, 900.0, o.uniform(0.1, 90))
        motion: dict[str, Any] = {
            "gravity": o.choice((None, None, 0.0, 3.0, 40.0)),
            "acceleration": o.choice((None, *accelerations)),
            "friction": o.choice((None, None, 0.0, *accelerations)),
        }
        if motion["acceleration"] is not None or (motion["friction"] is not None and walk_speed == 0):
            motion["air_control"] = o.choice((None, 0.0, 0.5, 1.0))
        return motion

    def _falls(self, kind: int) -> bool:
        """Whether gravity acts on a kind."""
        return self.oracle.fall(kind) > 0

    def _terrain(self) -> None:
        """Makes one to eight segments around the centre, with random blocks near it, often on a floor."""
        r = self.random
        density = r.choice((0.0, 0.02, 0.1, 0.3, 0.6))
        ground = r.random() < 0.7
        noise = np.random.default_rng(self.seed)
        home = [part // SEGMENT for part in self.center]
        for number in range(8):
            index = (home[0] - (number & 1), home[1] - (number >> 1 & 1), home[2] - (number >> 2))
            if number and r.random() < 0.2:
                continue
            kinds = np.zeros((SEGMENT, SEGMENT, SEGMENT), np.uint8)
            near = [
                slice(0, 9) if part == of else slice(SEGMENT - 9, SEGMENT) for part, of in zip(index, home, strict=True)
            ]
            patch = kinds[near[2], near[1], near[0]]
            patch[:] = noise.integers(1, 256, patch.shape) * (noise.random(patch.shape) < density)
            if ground and index[2] < home[2]:
                kinds[SEGMENT - 1] = 1
            self._load(index, kinds.reshape(-1))

    def _load(self, index: tuple[int, int, int], kinds: Kinds) -> None:
        self.world.load_segment(index, kinds)
        x, y, z = (part * SEGMENT for part in index)
        self.oracle.solid[index] = {
            (x + at % 32, y + at // 32 % 32, z + at // 1024) for at in np.flatnonzero(kinds).tolist()
        }

    # -- what can happen between two ticks -------------------------------------------------------------------

    def _somewhere(self, kind: int | None = None) -> tuple[float, float, float]:
        """Returns a random position near the centre: on the block grid, in halves, anywhere, or on top of an entity."""
        r = self.random
        if kind is not None and self.oracle.bodies and r.random() < 0.4:
            under = self.oracle.bodies[r.choice(list(self.oracle.bodies))]
            corner, top = self.oracle.box(under)
            offset, _ = self.oracle.box(Body(kind, [Fraction(0)] * 3, []))
            shift = r.choice((Fraction(0), Fraction(1, 4), GRID))
            return float(corner[0] - offset[0] + shift), float(corner[1] - offset[1]), float(top[2] - offset[2])
        parts = r.choice((1, 2, 1 << 30))
        x, y, z = (self.center[k] + r.randint(-self.span, self.span) + r.randrange(parts) / parts for k in range(3))
        return x, y, z

    def _spawn(self) -> None:
        r = self.random
        kind = r.randrange(len(self.scene.templates))
        position = self._somewhere(kind)
        speed = r.choice(SPEEDS)
        velocity = tuple(r.choice((0.0, speed, -speed, r.uniform(-speed, speed))) for _ in range(3))
        body = Body(
            kind,
            [nearest(Fraction(part), GRID) for part in position],
            [nearest(Fraction(part), Fraction(1, SPEED)) for part in velocity],
            falling=self._falls(kind) and velocity[2] * SPEED >= 0.5,
        )
        taken = self.oracle.taken(body)
        try:
            entity = self.world.spawn(
                self.scene.templates[kind].name, position, (velocity[0], velocity[1], velocity[2])
            )
        except OverlapError:
            assert taken, f"spawn at {position} refused"
            return
        assert not taken, f"spawn at {position} accepted"
        self.oracle.bodies[entity] = body

    def _some(self) -> int | None:
        return self.random.choice(sorted(self.oracle.bodies)) if self.oracle.bodies else None

    def _remove(self) -> None:
        entity = self._some()
        if entity is not None:
            self.world.remove(entity)
            del self.oracle.bodies[entity]

    def _place(self) -> None:
        entity = self._some()
        if entity is None:
            return
        body = self.oracle.bodies[entity]
        position = self._somewhere(body.kind)
        before = body.position
        body.position = [nearest(Fraction(part), GRID) for part in position]
        taken = self.oracle.taken(body)
        try:
            self.world.place(entity, position)
            assert not taken, f"teleport of {entity} to {position} accepted"
        except OverlapError:
            assert taken, f"teleport of {entity} to {position} refused"
            body.position = before

    def _become(self) -> None:
        entity = self._some()
        if entity is None:
            return
        body = self.oracle.bodies[entity]
        before, body.kind = body.kind, self.random.randrange(len(self.scene.templates))
        taken = self.oracle.taken(body)
        try:
            self.world.set_template(entity, self.scene.templates[body.kind].name)
            assert not taken, f"{entity} became {body.kind}"
            body.falling = body.falling and self._falls(body.kind)
        except OverlapError:
            assert taken, f"{entity} may not become {body.kind}"
            body.kind = before

    def _throw(self) -> None:
        entity = self._some()
        if entity is None:
            return
        speed = self.random.choice(SPEEDS)
        x, y, z = (self.random.uniform(-speed, speed) for _ in range(3))
        body = self.oracle.bodies[entity]
        velocity = [nearest(Fraction(part), Fraction(1, SPEED)) for part in (x, y, z)]
        if self.options.random() < 0.5:
            self.world.add_velocity(entity, (x, y, z))
            sums = (a + b for a, b in zip(body.velocity, velocity, strict=True))
            velocity = [min(max(part, Fraction(-1024)), Fraction(1024)) for part in sums]
        else:
            self.world.set_velocity(entity, (x, y, z))
        body.velocity = velocity
        body.falling = body.falling or (self._falls(body.kind) and body.velocity[2] > 0)

    def _edit(self) -> None:
        """Fills or clears a small box of blocks. The edit is refused as a whole if a solid entity is in the way."""
        r = self.random
        low = [int(part // 1) for part in self._somewhere()]
        high = [part + r.choice((1, 1, 2, 4)) for part in low]
        kind = r.choice((0, 0, 1, 2))
        cells = [
            (x, y, z) for x in range(low[0], high[0]) for y in range(low[1], high[1]) for z in range(low[2], high[2])
        ]
        if any(segment_of(*cell) not in self.oracle.solid for cell in cells):
            return
        met = kind and any(
            self.scene.templates[body.kind].solid and _overlap(self.oracle.box(body), (low, high))
            for body in self.oracle.bodies.values()
        )
        try:
            self.world.fill((low[0], low[1], low[2]), (high[0], high[1], high[2]), kind)
        except OverlapError:
            assert met, f"edit {low} to {high} refused"
            return
        assert not met, f"edit {low} to {high} accepted"
        for cell in cells:
            segment = self.oracle.solid[segment_of(*cell)]
            if kind:
                segment.add(cell)
            else:
                segment.discard(cell)

    def _reload(self) -> None:
        """Loads a segment, a new one or one that replaces another."""
        index = segment_of(*(int(part // 1) for part in self._somewhere()))
        density = self.random.choice((0.0, 0.01))
        self._load(
            index, (np.random.default_rng(self.random.randrange(1 << 30)).random(SEGMENT**3) < density).astype(np.uint8)
        )

    def _unload(self) -> None:
        """Unloads a segment, which is solid from then on. This is refused while entities are in it."""
        index = segment_of(*(int(part // 1) for part in self._somewhere()))
        if index not in self.oracle.solid:
            return
        met = any(tuple(part // SEGMENT for part in body.position) == index for body in self.oracle.bodies.values())
        try:
            self.world.unload_segment(index)
        except OverlapError:
            assert met, f"unloading {index} refused"
            return
        assert not met, f"unloading {index} accepted"
        del self.oracle.solid[index]

    def _put(self) -> None:
        """Writes states as a snapshot does, without any check. Some of them are written without a change."""
        states = []
        for entity, body in self.oracle.bodies.items():
            if self.random.random() < 0.5:
                continue
            if self.random.random() < 0.3:
                before = body.position
                body.position = [nearest(Fraction(part), GRID) for part in self._somewhere(body.kind)]
                if self.oracle.taken(body):
                    body.position = before
            states.append(_state(entity, body))
        self.world.put(states)

    def _rewind(self) -> None:
        """Replaces the world by a copy, steps that, and restores it. This must change nothing."""
        before = self.world.copy()
        self.world.step()
        if self.oracle.bodies and self.random.random() < 0.5:
            self.world.remove(self.random.choice(sorted(self.oracle.bodies)))
        self.world.step()
        if self.random.random() < 0.5:
            self.world = before
        else:
            self.world.restore(before)

    def _step(self) -> None:
        r = self.random
        inputs = {}
        for entity in self.oracle.bodies:
            if r.random() < 0.15:
                move = r.choice((0, 127, -127, r.randint(-127, 127))), r.choice((0, 127, -127, r.randint(-127, 127)))
                inputs[entity] = clamp(Input(*move, r.choice((0, 0, 1))))
        before = {entity: _state(entity, body)[1:] for entity, body in self.oracle.bodies.items()}
        self.world.step(inputs)
        self.oracle.step(inputs)  # type: ignore[arg-type]
        self._compare(before)

    def _compare(self, before: dict[int, tuple[int, ...]]) -> None:
        rows = self.world.rows(sorted(self.oracle.bodies))[:, :12]
        rows[:, 2] &= FALLING
        assert len(self.world) == len(self.oracle.bodies)
        for row, (entity, body) in zip(rows.tolist(), sorted(self.oracle.bodies.items()), strict=True):
            state = _state(entity, body)
            assert tuple(row) == state, f"entity {entity}: world {tuple(row)}, oracle {state}"
        fell, changed = set(self.world.fell), set(self.world.changed[:, 0].tolist())
        assert fell <= set(self.oracle.fell), "fell out of the world"
        for entity, state in before.items():
            if state != _state(entity, self.oracle.bodies[entity])[1:]:
                assert entity in changed, f"{entity} changed"
                assert entity in fell or entity not in self.oracle.fell, f"{entity} fell out of the world"


EVENTS: tuple[Callable[[Twins], None], ...] = (
    Twins._spawn, Twins._spawn, Twins._remove, Twins._place, Twins._become, Twins._throw, Twins._edit, Twins._edit,
    Twins._edit, Twins._reload, Twins._unload, Twins._put, Twins._rewind,
)  # fmt: skip


def _kind(template: Template) -> Kind:
    return Kind(
        [Fraction(part) for part in template.box_offset],
        [Fraction(part) for part in template.box_size],
        Fraction(template.walk_speed),
        Fraction(template.jump_speed),
        template.solid,
        *(
            None if value is None else Fraction(value)
            for value in (template.gravity, template.acceleration, template.friction, template.air_control)
        ),
    )


def _state(entity: int, body: Body) -> tuple[int, ...]:
    """Returns the 12 whole numbers of `World.state`."""
    place = [_whole(part, BLOCK) for part in body.position]
    speed = [_whole(part, SPEED) for part in body.velocity]
    return (entity, body.kind, int(body.falling), *place, *speed, *body.move, body.buttons)


def _overlap(a: tuple[Sequence[Fraction], ...], b: tuple[Sequence[int], ...]) -> bool:
    return all(p < s and q > r for p, q, r, s in zip(*a, *b, strict=True))


def _whole(value: Fraction, parts: int) -> int:
    """Returns a value as a number of these parts of 1."""
    whole, rest = divmod(value.numerator * parts, value.denominator)
    assert rest == 0, f"{value} is off the grid"
    return whole
