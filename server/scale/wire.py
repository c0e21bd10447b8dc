"""The messages between the parts of a world: batches of an edge to the sequencer, and records from it to all.

batch     [edge, number, before, inputs, requests]
          number: the tick that the inputs are for   before: number of the edge's batch before; -1: none
          inputs: as in a recording (`server.journal.records`)
request   [JOIN, client, name, subject, resume, token, beside, loaded]
          resume, token: digests of the presented resume token (empty: none) and of the new one
          beside: whether the client goes on over another connection until SWITCH   [SWITCH, client]
          loaded: result of `Rules.load_player`
          [HERE, 0, address]   the edge's address for clients; empty: it takes no more of them
          [KNOWS, client]   the client has the new token     [LOST, client]   [LEAVE, client]
          [COMMAND, client, number, tick, seen, name, payload, gaps]
record    [epoch, tick, batches, journal, placed, acted, removed, events, seated, ended, edges, margins]
          batches: edge, newest batch in it, ...   journal: a tick of a recording; nil: the record begins an epoch
          placed, acted, removed: entities   events: [players or nil, message], ...
          seated: edge, client, player, beside, ...   ended: edge, client, code, reason, ...
          code: the close code; `GONE`: the edge knows
          edges: edge, address, ... of all edges that take clients; nil: as before
          margins: for each edge in `batches`: time by which its newest batch was early, in 1/8192 s, negative if it was
          late; nil if no batch of it was taken in this tick

A client is a number that its edge gives to a connection. All of it is MessagePack.
"""

from typing import Any, NamedTuple

import msgpack

from shared.bounds import MARGINS_PER_S

GONE = 0
"""Close code in a record of a connection that its edge has lost."""
JOIN, KNOWS, LOST, LEAVE, COMMAND, SWITCH, HERE = range(7)


class Batch(NamedTuple):
    """The inputs of an edge for one tick, and the requests that came since the batch before."""

    edge: str
    number: int
    before: int
    inputs: list[int]
    requests: list[list[Any]]


class Record(NamedTuple):
    """One tick of the log, or the begin of an epoch."""

    epoch: int
    tick: int
    batches: list[Any]
    journal: list[Any] | None
    placed: list[int]
    acted: list[int]
    removed: list[int]
    events: list[Any]
    seated: list[Any]
    ended: list[Any]
    edges: list[str] | None = None
    margins: list[int | None] | None = None

    def margin_s(self, edge: str) -> float | None:
        """Returns the margin of an edge's newest batch in seconds; None: no batch of it was taken in this tick."""
        if self.margins is None or edge not in self.batches[::2]:
            return None
        margin = self.margins[self.batches[::2].index(edge)]
        return None if margin is None else margin / MARGINS_PER_S


def packed(value: Batch | Record) -> bytes:
    """Returns the bytes of a batch or a record."""
    data: bytes = msgpack.packb(list(value))
    return data


def batch_of(data: bytes) -> Batch:
    """Returns the batch in bytes of `packed`."""
    return Batch(*msgpack.unpackb(data))


def record_of(data: bytes) -> Record:
    """Returns the record in bytes of `packed`."""
    return Record(*msgpack.unpackb(data))


def rows(flat: list[Any], width: int) -> list[list[Any]]:
    """Returns a flat list as rows of a width."""
    return [flat[at : at + width] for at in range(0, len(flat), width)]
