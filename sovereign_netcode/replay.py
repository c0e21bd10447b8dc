"""Replays a recording of the server (--record FILE) and compares every tick. With --tick, shows what happened then.

Exits with 0 if all ticks are as recorded, 1 if a tick differs, and 2 if the file cannot be read as a recording.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import msgpack
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from server.journal.records import (
    FILL,
    LOAD,
    NOTE,
    PUT,
    REBASE,
    REMOVE,
    UNLOAD,
    WRITE,
    Call,
    DivergedError,
    JournalError,
    Recording,
)
from server.rules import RulesError, load_rules
from shared.behaviours import BehaviourError
from shared.inputs import Input
from shared.layout import BUTTONS, FALLING, FLAGS, ID, MOVE_X, MOVE_Y, TEMPLATE, VX, Int64s, X
from shared.units import BLOCK, BLOCK_SHIFT, SPEED
from shared.world import World

SEGMENT_CALLS = {LOAD: "loaded", UNLOAD: "unloaded", WRITE: "written"}
NEAR_BLOCKS = 4.0
FILE_WIDTH = 160
"""Width of the output in columns where it does not go to a terminal."""
FACES = (("west", 0, -1), ("east", 0, 1), ("south", 1, -1), ("north", 1, 1), ("below", 2, -1), ("above", 2, 1))


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="sovereign-replay",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording")
    parser.add_argument("--tick", type=int, metavar="T", help="show what happened around this tick")
    parser.add_argument(
        "--entity", type=int, metavar="ID", help="show what is near this entity (default: near each that changed at T)"
    )
    parser.add_argument("--around", type=int, default=8, metavar="N", help="ticks before and after (default: 8)")
    parser.add_argument(
        "--game", metavar="MODULE:CLASS", help="the rules of the recorded game, if it has behaviours; they are imported"
    )
    options = parser.parse_args(argv)
    if options.tick is None and options.entity is not None:
        parser.error("--entity needs --tick")
    if options.around < 0:
        parser.error("--around must not be negative")
    return options


class Scene(NamedTuple):
    """One tick of the recording, kept for the table: the world after it, and the inputs and calls that led to it."""

    world: World
    inputs: dict[int, Input]
    calls: list[Call]
    changed: list[int]


def main(argv: list[str] | None = None) -> int:
    options = arguments(argv)
    out = Console(width=None if sys.stdout.isatty() else FILE_WIDTH, highlight=False)
    kept: list[Scene] = []
    first = 0
    try:
        with options.file.open("rb") as file:
            recording = Recording(file, behaviours=load_rules(options.game).behaviours if options.game else ())
            first = recording.world.tick
            status = play(recording, file, out, options, kept)
    except DivergedError as error:
        out.print(f"[red]differs at {error}[/red]", soft_wrap=True)
        status = 1
    except RulesError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BehaviourError as error:
        print(f"error: {options.file}: {error}. Name the game that was recorded: --game MODULE:CLASS", file=sys.stderr)
        return 2
    except (JournalError, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        print(f"error: {options.file}: {reason}", file=sys.stderr)
        return 2
    if options.tick is not None:
        if not kept:
            print(f"error: tick {options.tick} is not in this recording, which begins at tick {first}", file=sys.stderr)
            return 2
        show(kept, options, out)
    return status


def play(recording: Recording, file: BinaryIO, out: Console, options: argparse.Namespace, kept: list[Scene]) -> int:
    """Replays to the end. Returns the exit code.

    Args:
        kept: receives the ticks that --tick selects, even if a later tick differs.
    """
    size = options.file.stat().st_size
    world, ticks, hashes, ended = recording.world, 0, 0, False
    wanted = range(0)
    if options.tick is not None:
        wanted = range(options.tick - options.around, options.tick + options.around + 1)
        if world.tick in wanted:
            kept.append(Scene(world.copy(), {}, [], []))
    columns = (TextColumn("tick {task.fields[tick]}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=out, transient=True, disable=not out.is_terminal) as progress:
        task = progress.add_task("", total=size, tick=world.tick)
        for moment in recording:
            ticks += not moment.ended
            hashes += moment.hashed
            ended = moment.ended
            if world.tick in wanted and not ended:
                changed = sorted(world.changed[:, ID].tolist())
                kept.append(Scene(world.copy(), moment.inputs, moment.calls, changed))
            if ticks % 64 == 0:
                progress.update(task, completed=file.tell(), tick=world.tick)
    out.print(
        f"[green]{ticks:,} ticks as recorded[/green], to tick {world.tick}: {hashes} hashes of the whole world, "
        f"{len(world)} entities, the last hash {world.state_hash().hex()}",
        soft_wrap=True,
    )
    if not ended:
        rest = f" ({recording.torn} bytes of an unfinished record were ignored)" if recording.torn else ""
        out.print(f"The recording has no end record: it breaks off after tick {world.tick}{rest}.")
    return 0


def show(kept: list[Scene], options: argparse.Namespace, out: Console) -> None:
    """Prints a table of what is near the entity of --entity, or near each entity that changed at the tick."""
    if options.entity is not None:
        wanted = [options.entity]
    else:
        wanted = next((scene.changed for scene in kept if scene.world.tick == options.tick), [])
    if not wanted:
        out.print(f"Nothing changed at tick {options.tick}.")
    for entity in wanted:
        table = Table(title=f"around entity {entity}", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for name in ("tick", "entity", "position", "velocity", "flag", "input"):
            table.add_column(name, no_wrap=True)
        table.add_column("contacts")
        for scene in kept:
            marked = "bold" if scene.world.tick == options.tick else ""
            for call in scene.calls:
                table.add_row("", "", f"[cyan]{described(call)}[/cyan]")
            for row in rows(scene, entity):
                table.add_row(*row, style=marked)
            table.add_section()
        out.print(table)
    out.print(
        "Input: east, north, buttons; * if new in this tick. Entities within 4 blocks, nearest first. Blocks and "
        "blocks/s."
    )


def rows(scene: Scene, entity: int) -> Iterator[tuple[str, ...]]:
    """Yields the lines of one tick: the entity, then the entities near it, nearest first."""
    world, tick = scene.world, str(scene.world.tick)
    if entity not in world:
        yield tick, f"{entity} does not exist", "", "", "", "", ""
        return
    states = world.states()
    centre = states[states[:, ID] == entity][0, X : X + 3]
    way = (states[:, X : X + 3] - centre) / BLOCK
    distance = np.sqrt((way * way).sum(axis=1))
    for i in np.lexsort((states[:, ID], distance)):
        if distance[i] > NEAR_BLOCKS:
            break
        state = states[i].tolist()
        place = " ".join(f"{part / BLOCK:.6f}" for part in state[X : X + 3])
        speed = " ".join(f"{part / SPEED:.3f}" for part in state[VX : VX + 3])
        falls = "falls" if state[FLAGS] & FALLING else ""
        name = world.scene.templates[state[TEMPLATE]].name
        star = "*" if state[ID] in scene.inputs else " "
        held = [name for name, bit in world.scene.button_bits.items() if state[BUTTONS] & bit]
        input_ = " ".join((f"{star}{state[MOVE_X]} {state[MOVE_Y]}", *held))
        touches = ", ".join(contacts(world, state[ID]))
        yield tick, f"{state[ID]} {name}", place, speed, falls, input_, touches
        tick = ""


def contacts(world: World, entity: int) -> list[str]:
    """Returns what touches each face of an entity's box, as in `below: block 3` and `east: #7`. Edges do not count."""
    found = []
    low, high, ids = boxes(world)
    me = int(np.flatnonzero(ids == entity)[0])
    lo, hi = low[me].tolist(), high[me].tolist()
    for name, axis, sign in FACES:
        others = [k for k in range(3) if k != axis]
        face = hi[axis] if sign > 0 else lo[axis]
        touching = (low if sign > 0 else high)[:, axis] == face
        for k in others:
            touching &= (low[:, k] < hi[k]) & (high[:, k] > lo[k])
        names = [f"#{other}" for other in ids[touching].tolist()]
        if face % BLOCK == 0:
            layer = (face >> BLOCK_SHIFT) - (sign < 0)
            spans = [range(lo[k] >> BLOCK_SHIFT, ((hi[k] - 1) >> BLOCK_SHIFT) + 1) for k in range(3)]
            spans[axis] = range(layer, layer + 1)
            kinds = {world.blocks.get(x, y, z) for x in spans[0] for y in spans[1] for z in spans[2]}
            names += [f"block {kind}" for kind in sorted(kind for kind in kinds if kind)]
            names += ["terrain that is not loaded"] * (None in kinds)
        if names:
            found.append(f"{name}: {' '.join(names)}")
    return found


def boxes(world: World) -> tuple[Int64s, Int64s, Int64s]:
    """Returns the low and high corners of all entities ([n, 3], grid steps) and their ids."""
    states = world.states()
    template = world.scene.kernel_tables()[0][states[:, TEMPLATE]]
    low = states[:, X : X + 3] + template[:, :3]
    return low, low + template[:, 3:6], states[:, ID]


def described(call: Call) -> str:
    """Returns a call as a readable text."""
    match call:
        case [int(op), *numbers] if op == PUT:
            places = (numbers[i : i + 12] for i in range(0, len(numbers), 12))
            return "; ".join(
                f"placed {row[ID]} at {' '.join(f'{part / BLOCK:.6f}' for part in row[X : X + 3])}" for row in places
            )
        case [int(op), entity] if op == REMOVE:
            return f"removed {entity}"
        case [int(op), x0, y0, z0, x1, y1, z1, kind, push] if op == FILL:
            return f"blocks {x0} {y0} {z0} to {x1} {y1} {z1} set to {kind}{' with a push' if push else ''}"
        case [int(op), x, y, z, *_] if op in (LOAD, UNLOAD, WRITE):
            return f"segment {x} {y} {z} {SEGMENT_CALLS[op]}"
        case [int(op), tick] if op == REBASE:
            return f"tick number set to {tick}"
        case [int(op), bytes(value)] if op == NOTE:
            return f"note: {msgpack.unpackb(value, strict_map_key=False)}"
    return str(call)


if __name__ == "__main__":
    sys.exit(main())
