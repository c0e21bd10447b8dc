"""The JavaScript loader of the kernel (client_sdk/web/kernel.js) steps a world as Python does, state by state."""

import base64
import json
import random
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from shared.inputs import Input
from shared.scene import BlockKind, Scene, load_scene
from shared.units import SEGMENT
from shared.world import OverlapError, World

NODE = shutil.which("node")
LOADER = Path(__file__).with_name("loader.mjs")
TICKS = 200
pytestmark = pytest.mark.skipif(NODE is None, reason="there is no Node.js")


def moving() -> Scene:
    """Returns a scene with friction, air control, a passable kind of blocks, and a lift that carries others."""
    scene = load_scene("flat")
    scene = scene.with_changes("player", acceleration=30.0, friction=12.0, air_control=0.3)
    scene = scene.with_template("puck", walk_speed=0.0, jump_speed=0.0, friction=2.0, acceleration=None)
    scene = scene.with_template(
        "lift", box_size=(2.0, -2.0, 0.5), walk_speed=0.0, jump_speed=0.0, gravity=0.0, carries=True,
        acceleration=None, friction=None, air_control=None,
    )  # fmt: skip
    return replace(scene, integrator="semi", tick_rate=30, kinds=(BlockKind("water", 9, solid=False),))


SCENES = {name: lambda name=name: load_scene(name) for name in ("arena", "hills", "topdown")} | {"moving": moving}


def states(world: World) -> list[list[int]]:
    found: list[list[int]] = world.states().tolist()
    return found


def run(scene: Scene, ticks: int) -> dict[str, Any]:
    """Returns a run: what was done to a world, and the states after each tick."""
    world, rng = World(scene), random.Random(5)
    world.load_terrain()
    segments = [
        [list(index), base64.b64encode(world.blocks.segment(index).tobytes()).decode()] for index in scene.segments()
    ]
    ops: list[list[Any]] = []
    players: list[int] = []
    while len(players) < 5:
        x, y, z = rng.choice(scene.spawns)
        try:
            near = (x + rng.uniform(-4, 4), y + rng.uniform(-4, 4), z + rng.uniform(0, 3))
            players.append(world.spawn(rng.choice(scene.templates).name, near, push=True))
        except OverlapError:
            continue
    world.set_velocity(players[0], (3.0, -2.0, 1.0))
    ops.append(["put", states(world)])
    edits: list[list[int]] = []
    for tick in range(ticks):
        inputs = {
            entity: Input(rng.randint(-127, 127), rng.randint(-127, 127), rng.choice((0, 0, 1)))
            for entity in players
            if rng.random() < 0.1
        }
        if tick % 20 == 7:
            x, y, z = (int(part // 1) + rng.randint(-2, 1) for part in world.position(rng.choice(players)))
            kind = 0 if world.blocks.get(x, y, z) else rng.choice((1, 9))
            if (x // SEGMENT, y // SEGMENT, z // SEGMENT) in world.blocks:
                try:
                    world.set_block(x, y, z, kind)
                    edits.append([x, y, z, kind])
                    ops.append(["block", x, y, z, kind])
                except OverlapError:
                    pass
        if tick == ticks // 2:
            ops.append(["again", list(edits)])
        world.step(inputs)
        ops.append(["step", [[entity, list(each[:3])] for entity, each in inputs.items()], states(world), world.fell])
        for entity in world.fell:
            world.place(entity, scene.spawns[0], push=True)
            ops.append(["put", [list(world.state(entity))]])
    names = ("templates", "walk", "parameters")
    tables = dict(zip(names, (table.tolist() for table in scene.kernel_tables()), strict=True))
    return {"scene": scene.to_table(), "tables": tables, "segments": segments, "ops": ops}


@pytest.mark.parametrize("name", SCENES)
def test_every_state_of_a_run(name: str, tmp_path: Path) -> None:
    assert NODE is not None
    path = tmp_path / "run.json"
    path.write_text(json.dumps(run(SCENES[name](), TICKS)), "utf-8")
    done = subprocess.run([NODE, str(LOADER), str(path)], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == ""
    assert done.stdout == f"{TICKS} ticks\n"
