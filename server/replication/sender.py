"""Sending: the newest snapshot to each client whose connection has room, then game events and terrain.

Theory of operation. Once per tick `serve` is called for each client. If more bytes are on the way to the client than
flow control allows (`flow_control`), the tick is left out; the next snapshot has the union of the changes. The client
view (`client_view`) chooses the segments of a snapshot. The change log (`change_log`) encodes the changes of a segment,
once for all clients. Shared values and game events follow the snapshot; an event is not sent before a snapshot that has
the entities it names (`server.players.outbox`). The blocks of new segments follow last, in pieces, as far as there is
room, so terrain never delays a snapshot.
"""

from collections.abc import Collection, Iterable

import numpy as np

from server.config.limits import Limits
from server.observability.counters import Counters
from server.players.player import Player
from server.replication import interest
from server.replication.change_log import ChangeLog
from server.replication.client_stream import ClientStream
from shared import fields, messages
from shared.checks import Cell
from shared.messages import Terrain, encode, head_of, pack
from shared.snapshot import VERDICT
from shared.world import World

TERRAIN = head_of(Terrain)[1]
"""First value of each message `Terrain`."""
GAPS_S = 2.0
"""Seconds for which gaps between a client's snapshots are kept: longer than lag compensation can look back."""
EVENT_BYTES = 128
"""Bytes of game events, about, that may go with each snapshot even if terrain waits."""
SNAPSHOT_BYTES = fields.MESSAGE_MAX // 2
"""Maximum bytes of a snapshot, about. Further segments wait for the next snapshot, but never the own segment and one
more."""


class Sender:
    """The sender of snapshots, game events and terrain to all clients.

    Args:
        world: the world.
        log: the changes of the world.
        limits: the limits.
        counters: where snapshots and bytes are counted.
    """

    def __init__(self, world: World, log: ChangeLog, limits: Limits, counters: Counters) -> None:
        self._world, self._log, self._limits, self._counters = world, log, limits, counters
        self._tick_s = 1 / world.scene.tick_rate
        self._around: dict[Cell, tuple[Cell, ...]] = {}
        """Segments around a segment, by the latter. Clients share the tuples, which `DeltaCache.together` relies on."""

    def serve(self, stream: ClientStream, player: Player, now: float) -> None:
        """Sends a client the snapshot of the latest recorded tick, and what follows it, if its connection has room."""
        pacing, near, centre = stream.flow, stream.view.near, self._log.segment(player.entity)
        if not near or near[0] != centre:
            self._look_around(stream, centre)
        window = pacing.window(stream.snapshot_bytes, self._tick_s, now)
        plain = window
        if stream.acked < 0:
            window = max(window, self._limits.first_bytes)
        if (outstanding := pacing.outstanding) > window:
            self._counters.snapshots_skipped += 1
            return
        stream.sent_at = now
        self._send_snapshot(stream, player, min(pacing.room(window), SNAPSHOT_BYTES))
        self._send_told(stream, player, plain)
        if outstanding == 0 and stream.probe is None:
            stream.probe = (self._world.tick, now, stream.snapshot_bytes)
        if stream.terrain_now or stream.terrain_due:
            pacing.look()
            self._send_terrain(stream, window - pacing.outstanding)

    def acked(self, stream: ClientStream, tick: int, now: float) -> None:
        """Handles the acknowledgement of a client: it has applied the snapshot of a tick."""
        if stream.acked < tick <= stream.tick:
            stream.acked = tick
            stream.flow.acked(tick)
            if stream.probe is not None and tick >= stream.probe[0]:
                probe, sent_at, size = stream.probe
                stream.probe = None
                if tick == probe:
                    stream.flow.answered(now - sent_at, size, now)

    def forget(self, stream: ClientStream) -> None:
        """Starts over with a client: its next snapshots have keyframes, and all terrain is sent again."""
        stream.view.forget()
        self._renew_terrain(stream, stream.view.sees)

    def _look_around(self, stream: ClientStream, centre: Cell) -> None:
        """Updates the client view after the entity has come into another segment."""
        sight = stream.view
        exists = self._world.blocks.rows.__contains__
        near = interest.around(centre, self._limits.see_radius, exists)
        if self._around.get(centre) != near:
            self._around[centre] = near
        added, dropped = sight.move(self._around[centre], self._limits.keep_radius, self._world.tick)
        waiting = [segment for segment in stream.terrain_due if segment in sight.sees]
        new = [segment for segment in added if exists(segment)]  # nearest first already
        stream.terrain_due = self._nearest(stream, waiting + new) if waiting else new
        if stream.terrain_now and stream.terrain_now[0] in dropped:
            stream.terrain_now = None

    def _renew_terrain(self, stream: ClientStream, segments: Collection[Cell]) -> None:
        """Queues the blocks of segments to be sent, or to be sent again."""
        if stream.terrain_now and stream.terrain_now[0] in segments:
            stream.terrain_now = None
        due = {segment for segment in segments if segment in self._world.blocks}
        stream.terrain_due = self._nearest(stream, sorted(due.union(stream.terrain_due)))

    def _nearest(self, stream: ClientStream, segments: Iterable[Cell]) -> list[Cell]:
        """Returns segments in the order in which their blocks are sent: the nearest first."""
        own = stream.view.near[0] if stream.view.near else (0, 0, 0)
        return sorted(segments, key=lambda segment: interest.distance(segment, own))

    def _send_snapshot(self, stream: ClientStream, player: Player, room: int) -> None:
        tick, inputs, sight = self._world.tick, player.inputs, stream.view
        if sight.lost_track(tick, self._log.history):
            self._renew_terrain(stream, sight.lose(tick, self._log.history))
        drops = np.array(sight.drops, "<i4").tobytes() if sight.drops else b""
        n, parts = sight.take(self._log, tick, room)
        verdicts = b""
        if player.verdicts:
            answers = player.verdicts[: fields.VERDICTS_MAX]
            verdicts = b"".join(VERDICT.pack(*answer) for answer in answers)
            for number in [number for number, _ in answers if number in player.reasons] if player.reasons else ():
                stream.send(encode(messages.Refusal(number, player.reasons[number])))
            del player.verdicts[: fields.VERDICTS_MAX]
        margins, statuses = inputs.take_feedback()
        header = (tick, inputs.newest, margins, tick - len(statuses) + 1, statuses, verdicts, drops)
        message = messages.join_snapshot(header, n, parts)
        stream.send(message)
        stream.flow.sent(tick)
        if tick - stream.tick > 1 and stream.tick >= 0:
            kept = tick - GAPS_S / self._tick_s
            stream.gaps = (*(gap for gap in stream.gaps if gap[1] > kept), (stream.tick, tick))
        stream.tick = tick
        size = stream.snapshot_bytes = len(message)
        self._counters.snapshots_sent += 1
        self._counters.snapshot_bytes += size

    def _send_told(self, stream: ClientStream, player: Player, window: int) -> None:
        """Sends the shared values, and game events as far as the window has room.

        If terrain is due, events get half of the room. A client that has not acknowledged anything is still joining and
        could not show the events; they wait until there is room and no terrain is due.

        Args:
            stream: the sending state of the client.
            player: the client's player.
            window: bytes that may be on the way.
        """
        if stream.shared_due:
            stream.send(stream.shared_due)
            stream.shared_due = b""
        if stream.private_due:
            stream.send(stream.private_due)
            stream.private_due = b""
        outbox, pacing = player.outbox, stream.flow
        if not outbox.due:
            return
        room, terrain = window - pacing.outstanding, stream.terrain_now or stream.terrain_due
        if stream.acked < 0 and (terrain or room <= 0):
            return
        for message in outbox.take(
            stream.view.complete_tick, max(room // 2, EVENT_BYTES) if terrain else pacing.room(window)
        ):
            stream.send(message)

    def _send_terrain(self, stream: ClientStream, room: int) -> None:
        """Sends terrain as far as the room in bytes allows.

        A segment's blocks are never sent before its keyframe. A keyframe has no edits, so the client would miss the
        edits between the two.
        """
        room, most = min(room, self._limits.terrain_bytes_per_tick), self._limits.terrain_chunk_bytes
        while room > 0 and (stream.terrain_now or stream.terrain_due):
            if stream.terrain_now is None:
                segment = stream.view.begun(stream.terrain_due)
                blocks = None if segment is None else self._log.packed(segment)
                if segment is None or blocks is None:
                    return
                stream.terrain_due.remove(segment)
                stream.terrain_now = (segment, blocks, 0)
            segment, packed, offset = stream.terrain_now
            chunk = packed[offset : offset + most]
            stream.send(pack((TERRAIN, *segment, offset, len(packed), chunk)))
            offset += len(chunk)
            stream.terrain_now = (segment, packed, offset) if offset < len(packed) else None
            room -= len(chunk)
            self._counters.terrain_bytes += len(chunk)
