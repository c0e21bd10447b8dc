"""The live page: a map of the world and the server's figures, drawn by a browser.

    /              the page, one file that loads nothing from other servers
    /live          JSON: positions of entities, figures, and the version of each tile of the map
    /live/0, 1 ..  a tile of the map: zlib of 64 x 64 u16 heights, then 64 x 64 u8 kinds, in rows from the south-west

The answers are computed when they are requested, at most `ANSWERS_PER_S` times per second for any number of viewers.
Their size is bounded: of many entities every n-th is shown, of a large world every n-th block. Without viewers the page
costs nothing.
"""

import base64
import hashlib
import json
import re
import zlib
from collections.abc import Callable, Mapping
from functools import cache, partial
from http import HTTPStatus
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from server.observability.histogram import Histogram
from server.observability.pages import JSON, Page
from shared.blocks import AIR, Kinds
from shared.fields import NAME_MAX
from shared.layout import ID, TEMPLATE, Int64s, X, Y, Z
from shared.scene import Scene
from shared.units import BLOCK, SEGMENT
from shared.world import World

if TYPE_CHECKING:
    from server.players.persisted_state import PersistedState
    from server.players.player import Player

ANSWERS_PER_S = 8
"""Maximum number of times per second that `/live` is computed."""
SHOWN_MAX = 1000
"""Maximum number of players in `/live`, and about the maximum number of other entities."""
SIDE_MAX = 512
"""Maximum number of cells along a side of the map. A cell shows one column of blocks of every `step` in x and y."""
VERSION_BYTES = 6
"""Bytes of a tile's version. A number in JavaScript cannot hold whole numbers of eight bytes."""
TILE = 64
"""Number of cells along a side of a tile."""
FIGURES = (
    "tick tick_rate ticks ticks_late skipped_s clients connections entities entities_awake inputs_used inputs_late "
    "inputs_substituted snapshots_sent snapshots_skipped snapshot_bytes terrain_bytes corrections ready uptime_s cpu_s "
    "rss_mb"
).split()
"""Names of the figures of `/stats` that the page shows."""
HEADERS = (("Cache-Control", "no-store"), ("X-Content-Type-Options", "nosniff"))
"""HTTP headers of all answers."""


class Relief:
    """A map of a world's ground in tiles. A tile is computed when it is requested and has changed since."""

    def __init__(self, world: World) -> None:
        self._blocks = world.blocks
        self._origin, self._segments = np.array(world.scene.origin), world.scene.size
        width, depth, _ = self._segments
        self.step = 1
        while max(width, depth) * SEGMENT > SIDE_MAX * self.step:
            self.step *= 2
        self._side = TILE * self.step // SEGMENT  # segments along a side of a tile
        self.columns, self.rows = -(-width // self._side), -(-depth // self._side)
        self._packed: dict[int, tuple[int, bytes]] = {}

    def versions(self) -> list[int]:
        """Returns the version of each tile, row by row from the south-west. It changes with the blocks of the tile."""
        self._blocks.freshen()
        table = self._table()
        return [self._version(self._part(table, number)) for number in range(self.columns * self.rows)]

    def tile(self, number: int) -> bytes:
        """Returns the bytes of one tile. A height counts from the lowest block of the world; 0 means no block."""
        self._blocks.freshen()
        rows = self._part(self._table(), number)
        version = self._version(rows)
        if self._packed.get(number, (-1, b""))[0] != version:
            heights, kinds = np.zeros((TILE, TILE), "<u2"), np.zeros((TILE, TILE), np.uint8)
            stride = max(self.step // SEGMENT, 1)  # more than 1 if a cell is wider than a segment
            found = self._tops(rows[::stride, ::stride])
            depth, width = found[0].shape
            heights[:depth, :width], kinds[:depth, :width] = found
            self._packed[number] = (version, zlib.compress(heights.tobytes() + kinds.tobytes(), 1))
        return self._packed[number][1]

    def _tops(self, rows: Int64s) -> tuple[Int64s, Kinds]:
        """Returns height and kind of the highest block of each column, [y, x].

        Args:
            rows: rows of segments in the arrays of `Blocks`, [y, x, z].
        """
        cells = self._blocks.kinds.reshape(-1, SEGMENT, SEGMENT, SEGMENT)[:, :, :: self.step, :: self.step]
        depth, width = (part * cells.shape[2] for part in rows.shape[:2])
        heights, kinds = np.zeros((depth, width), np.int64), np.zeros((depth, width), np.uint8)
        for level in reversed(range(rows.shape[2])):
            column = cells[rows[:, :, level]].transpose(2, 0, 3, 1, 4).reshape(SEGMENT, depth, width)[::-1]
            depth_of_top = (column != AIR).argmax(axis=0)
            kind = np.take_along_axis(column, depth_of_top[None], axis=0)[0]
            visible = (heights == 0) & (kind != AIR)
            heights[visible] = (level + 1) * SEGMENT - depth_of_top[visible]
            kinds[visible] = kind[visible]
            if heights.all():
                break
        return heights, kinds

    def _table(self) -> Int64s:
        """Returns the row of each segment of the scene in the arrays of `Blocks`, [y, x, z]; 0: not loaded."""
        width, depth, height = self._segments
        table = np.zeros((depth, width, height), np.int64)
        rows = np.fromiter(self._blocks.rows.values(), np.int64, len(self._blocks.rows))
        at = self._blocks.segments[rows] - self._origin
        inside = ((at >= 0) & (at < self._segments)).all(axis=1)
        x, y, z = at[inside].T
        table[y, x, z] = rows[inside]
        return table

    def _part(self, table: Int64s, number: int) -> Int64s:
        row, column = divmod(number, self.columns)
        side = self._side
        part: Int64s = table[row * side : (row + 1) * side, column * side : (column + 1) * side]
        return part

    def _version(self, rows: Int64s) -> int:
        return int.from_bytes(hashlib.sha256(self._blocks.digests[rows].tobytes()).digest()[:VERSION_BYTES])


class Shown(Protocol):
    """A game, or a part of a world on many processes, as the live page shows it."""

    scene: Scene

    @property
    def world(self) -> World:
        """The world."""
        ...

    @property
    def kept(self) -> "PersistedState":
        """The persisted state."""
        ...

    @property
    def players(self) -> "dict[int, Player]":
        """Players by entity."""
        ...


class Live:
    """The live pages of one game.

    Args:
        game: the game.
        figures: returns the figures of `/stats`.
        durations: returns the histograms to show, by name.
    """

    def __init__(
        self, game: Shown, figures: Callable[[], Mapping[str, Any]], durations: Callable[[], Mapping[str, Histogram]]
    ) -> None:
        self._game, self._figures, self._durations = game, figures, durations
        self._relief = Relief(game.world)
        self._answer: tuple[int, Page] | None = None

    def pages(self) -> dict[str, Callable[[], Page]]:
        """Returns the functions that make the pages, by path."""
        tiles = range(self._relief.columns * self._relief.rows)
        made = {f"/live/{number}": partial(self._tile, number) for number in tiles}
        return {"/": html_page, "/live": self._state, **made}

    def _tile(self, number: int) -> Page:
        return Page(HTTPStatus.OK, self._relief.tile(number), "application/octet-stream", HEADERS)

    def _state(self) -> Page:
        tick, rate = self._game.world.tick, self._game.scene.tick_rate
        if self._answer is None or tick - self._answer[0] >= rate / ANSWERS_PER_S:
            body = json.dumps(self.state(), separators=(",", ":")).encode()
            self._answer = (tick, Page(HTTPStatus.OK, body, JSON, HEADERS))
        return self._answer[1]

    def state(self) -> dict[str, Any]:
        """Returns the content of `/live`.

        Positions are in hundredths of a block; sizes of templates and of the map are in blocks.
        """
        game, relief = self._game, self._relief
        scene, figures = game.scene, self._figures()
        shown = list(islice(game.players, SHOWN_MAX))
        listed = np.concatenate([game.world.rows(shown), self._sample()])
        listed = listed[np.sort(np.unique(listed[:, ID], return_index=True)[1])]
        listed[:, X : Z + 1] = listed[:, X : Z + 1] * 100 // BLOCK
        ids = listed[:, ID].tolist()
        names = ((entity, game.kept.attributes.get(entity, {}).get("name")) for entity in ids)
        return {
            "scene": scene.name,
            "templates": [
                [each.name, *each.box_offset, *each.box_size, each.walk_speed > 0] for each in scene.templates
            ],
            "map": {
                "origin": [part * SEGMENT for part in scene.origin],
                "size": [part * SEGMENT for part in scene.size],
                "step": relief.step,
                "columns": relief.columns,
                "versions": relief.versions(),
            },
            "entities": listed[:, [ID, TEMPLATE, X, Y, Z]].reshape(-1).tolist(),
            "names": {entity: name[:NAME_MAX] for entity, name in names if isinstance(name, str)},
            "players": shown,
            "away": [entity for entity in shown if game.players[entity].session is None],
            "shared": {name: _shown(value) for name, value in game.kept.shared.items()},
            "figures": {name: figures[name] for name in FIGURES if name in figures},
            "durations": {name: histogram.counts() for name, histogram in self._durations().items()},
        }

    def _sample(self) -> Int64s:
        """Returns the rows of at most about `SHOWN_MAX` entities, mostly the same ones in each call."""
        matrix = self._game.world.matrix
        rows: Int64s = matrix[:: max(-(-len(matrix) // SHOWN_MAX), 1)]
        there: Int64s = rows[rows[:, ID] != 0]
        return there


def _shown(value: Any) -> Any:
    """Returns a shared value, or a text for it if JSON cannot hold it (bytes, NaN)."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return str(value)
    return value


@cache
def html_page(name: str = "live.html") -> Page:
    """Returns a page of this folder: the live page, or another one.

    Its content security policy allows only its own script, its own style, and requests to this server.
    """
    text = Path(__file__).with_name(name).read_text("utf-8")
    hashes = {
        tag: base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
        for tag, inside in re.findall(r"<(style|script)>(.*?)</\1>", text, re.DOTALL)
    }
    policy = (
        f"default-src 'none'; script-src 'sha256-{hashes['script']}'; style-src 'sha256-{hashes['style']}'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    headers = (("Content-Security-Policy", policy), ("Referrer-Policy", "no-referrer"), *HEADERS)
    return Page(HTTPStatus.OK, text.encode(), "text/html; charset=utf-8", headers)
