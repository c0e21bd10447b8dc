"""What each client is sent: the newest snapshot if its path has room, and terrain behind it.

Theory of operation. Once a tick each session is served, or not: if more is on the way to it than `pacing` allows, it
is left out, and gets the union of what it missed with its next snapshot. What goes into that is `sight`'s choice; the
bytes of a segment's changes are `replication`'s, made once for all. A segment's blocks follow in pieces, behind the
snapshot, as far as there is room: terrain never makes a snapshot late. What the rules tell goes behind the snapshot
that has what it speaks of (`outbox`).
"""

from collections import deque
from collections.abc import Collection, Iterable

import numpy as np

from server import interest
from server.counters import Counters
from server.limits import Limits
from server.replication import ChangeLog
from server.session import Session
from shared import messages
from shared.checks import Cell
from shared.messages import Terrain, encode
from shared.snapshot import VERDICT
from shared.world import World

GAPS_S = 2.0
"""Gaps between a client's snapshots are kept for this time, in seconds: longer than lag compensation reaches back."""
EVENT_BYTES = 128
"""About so many bytes of events may go with each snapshot, however much terrain waits."""
SNAPSHOT_BYTES = messages.MESSAGE_MAX // 2
"""What more there is waits for the next snapshot, however wide the path; the own segment and one more never do."""


class Delivery:
    """Sends to sessions what there is for them."""

    def __init__(self, world: World, log: ChangeLog, limits: Limits, counters: Counters) -> None:
        self._world, self._log, self._limits, self._counters = world, log, limits, counters
        self._tick_s = 1 / world.scene.tick_rate
        self._around: dict[Cell, tuple[Cell, ...]] = {}
        """What was seen from a segment by the latest who came into it."""

    def serve(self, session: Session, now: float) -> None:
        """Sends a session the tick that has been recorded, if its path has room."""
        pacing, near, centre = session.pacing, session.sight.near, self._log.segment(session.entity)
        if not near or near[0] != centre:
            self._look_around(session, centre)
        window = pacing.window(session.snapshot_bytes, self._tick_s, now)
        plain = window
        if session.acked < 0:
            window = max(window, self._limits.first_bytes)
        if (outstanding := pacing.outstanding) > window:
            self._counters.snapshots_skipped += 1
            return
        session.sent_at = now
        self._send_snapshot(session, min(pacing.room(window), SNAPSHOT_BYTES))
        self._send_told(session, plain)
        if outstanding == 0 and session.probe is None:
            session.probe = (self._world.tick, now, session.snapshot_bytes)
        if session.terrain_now or session.terrain_due:
            pacing.look()
            self._send_terrain(session, window - pacing.outstanding)

    def acked(self, session: Session, tick: int, now: float) -> None:
        """The client has applied the snapshot of a tick."""
        if session.acked < tick <= session.tick:
            session.acked = tick
            session.pacing.acked(tick)
            if session.probe is not None and tick >= session.probe[0]:
                probe, sent_at, size = session.probe
                session.probe = None
                if tick == probe:
                    session.pacing.answered(now - sent_at, size, now)

    def forget(self, session: Session) -> None:
        """Begins anew with what a client sees: keyframes and terrain."""
        session.sight.forget()
        self._renew_terrain(session, session.sight.sees)

    def _look_around(self, session: Session, centre: Cell) -> None:
        """The entity is in another segment."""
        sight = session.sight
        exists = self._world.blocks.__contains__
        near = interest.around(centre, self._limits.see_radius, exists)
        if self._around.get(centre) != near:
            self._around[centre] = near
        added, dropped = sight.move(self._around[centre], self._limits.keep_radius, self._world.tick)
        due = [segment for segment in session.terrain_due if segment in sight.sees] + [s for s in added if exists(s)]
        session.terrain_due = self._nearest(session, due)
        if session.terrain_now and session.terrain_now[0] in dropped:
            session.terrain_now = None

    def _renew_terrain(self, session: Session, segments: Collection[Cell]) -> None:
        """The blocks of these segments are to be sent, or sent again."""
        if session.terrain_now and session.terrain_now[0] in segments:
            session.terrain_now = None
        due = {segment for segment in segments if segment in self._world.blocks}
        session.terrain_due = self._nearest(session, sorted(due.union(session.terrain_due)))

    def _nearest(self, session: Session, segments: Iterable[Cell]) -> deque[Cell]:
        """Segments in the order in which their blocks are sent."""
        own = session.sight.near[0] if session.sight.near else (0, 0, 0)
        return deque(sorted(segments, key=lambda segment: interest.distance(segment, own)))

    def _send_snapshot(self, session: Session, room: int) -> None:
        tick, inputs, sight = self._world.tick, session.inputs, session.sight
        if sight.lost_track(tick, self._log.history):
            self._renew_terrain(session, sight.lose(tick, self._log.history))
        drops = np.array(sight.drops, "<i4").tobytes() if sight.drops else b""
        n, parts = sight.take(self._log, tick, room)
        player, verdicts = session.player, b""
        assert player is not None
        if player.verdicts:
            verdicts = np.array(player.verdicts[: messages.VERDICTS_MAX], VERDICT).tobytes()
            del player.verdicts[: messages.VERDICTS_MAX]
        margins, fates = inputs.told()
        header = (tick, inputs.newest, margins, tick - len(fates) + 1, fates, verdicts, drops)
        message = messages.join_snapshot(header, n, parts)
        session.send(message)
        session.pacing.sent(tick)
        if tick - session.tick > 1 and session.tick >= 0:
            kept = tick - GAPS_S / self._tick_s
            session.gaps = (*(gap for gap in session.gaps if gap[1] > kept), (session.tick, tick))
        session.tick = tick
        size = session.snapshot_bytes = len(message)
        self._counters.snapshots_sent += 1
        self._counters.snapshot_bytes += size

    def _send_told(self, session: Session, window: int) -> None:
        """Sends what the rules have told: shared values, and events as far as they fit into what may be on the way.

        Where terrain is due, half of that is left to it. A client that has not acknowledged anything is still joining
        and would only keep the events: they do not go until nothing has to wait for them.
        """
        if session.shared_due:
            session.send(session.shared_due)
            session.shared_due = b""
        assert session.player is not None
        outbox, pacing = session.player.outbox, session.pacing
        if not outbox.due:
            return
        room, terrain = window - pacing.outstanding, session.terrain_now or session.terrain_due
        if session.acked < 0 and (terrain or room <= 0):
            return
        for message in outbox.take(
            session.sight.known, max(room // 2, EVENT_BYTES) if terrain else pacing.room(window)
        ):
            session.send(message)

    def _send_terrain(self, session: Session, room: int) -> None:
        """Terrain behind the snapshot, as far as it fits into what may be on the way.

        A segment's blocks never go before its keyframe, which tells no edits: those in between would be lost.
        """
        room = min(room, self._limits.terrain_bytes_per_tick)
        while room > 0 and (session.terrain_now or session.terrain_due):
            if session.terrain_now is None:
                segment = next((segment for segment in session.terrain_due if session.sight.begun(segment)), None)
                blocks = None if segment is None else self._log.packed(segment)
                if segment is None or blocks is None:
                    return
                session.terrain_due.remove(segment)
                session.terrain_now = (segment, blocks, 0)
            segment, packed, offset = session.terrain_now
            chunk = packed[offset : offset + self._limits.terrain_chunk_bytes]
            session.send(encode(Terrain(*segment, offset, len(packed), chunk)))
            offset += len(chunk)
            session.terrain_now = (segment, packed, offset) if offset < len(packed) else None
            room -= len(chunk)
            self._counters.terrain_bytes += len(chunk)
