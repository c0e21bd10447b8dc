"""The packed turns of a segment, written and read as docs/protocol.md describes them, without the kernel.

A turn is a list as in `layout.TURN`: id, events, input (3), position (3).
"""

from collections.abc import Iterable, Iterator, Sequence

from shared.layout import EDGE_HIGH, NEW_BUTTONS, NEW_MOVE, STOP_X, TOLD
from shared.units import BLOCK, SEGMENT

SIDE = SEGMENT * BLOCK
PLAIN = TOLD | NEW_MOVE


def stop_of(place: int, low: int, high: int) -> int:
    """Returns the position in a turn for a position within a segment.

    Args:
        place: the position, in grid steps.
        low: low side of the entity's box, relative to its position.
        high: high side of it.
    """
    if (place + low) % BLOCK == 0:
        return -1 - (place + low) // BLOCK % SEGMENT
    if (place + high) % BLOCK == 0:
        return -1 - ((place + high) // BLOCK % SEGMENT | EDGE_HIGH)
    return place


def pack_turns(turns: Iterable[Sequence[int]]) -> bytes:
    """Returns turns, whose ids ascend, as bytes."""
    packed, last = bytearray(), 0
    for entity, events, move_x, move_y, buttons, *places in turns:
        gap, last = entity - last - 1, entity
        packed.append(gap % 64 | (gap >= 64) << 6 | (events != PLAIN) << 7)
        gap //= 64
        while gap:
            packed.append(gap % 128 | (gap >= 128) << 7)
            gap //= 128
        if events != PLAIN:
            packed.append(events)
        if events & TOLD and events & NEW_MOVE:
            packed += bytes((move_x % 256, move_y % 256))
        if events & TOLD and events & NEW_BUTTONS:
            packed.append(buttons)
        for axis, place in enumerate(places):
            if events & STOP_X << axis:
                packed += bytes((-1 - place,)) if place < 0 else _within(place)
    return bytes(packed)


def _within(place: int) -> bytes:
    return bytes((128 | place // BLOCK,)) + (place % BLOCK).to_bytes(3, "little")


def unpack_turns(packed: bytes) -> Iterator[list[int]]:
    """Yields the turns in bytes that `pack_turns` has returned."""
    rest, entity = iter(packed), 0
    for head in rest:
        gap, more, factor = head % 64, head & 64, 64
        while more:
            part = next(rest)
            gap, more, factor = gap + part % 128 * factor, part & 128, factor * 128
        entity += gap + 1
        turn = [entity, next(rest) if head & 128 else PLAIN, 0, 0, 0, 0, 0, 0]
        if turn[1] & TOLD and turn[1] & NEW_MOVE:
            turn[2:4] = [(next(rest) ^ 128) - 128 for _ in range(2)]
        if turn[1] & TOLD and turn[1] & NEW_BUTTONS:
            turn[4] = next(rest)
        for axis in range(3):
            if turn[1] & STOP_X << axis:
                first = next(rest)
                turn[5 + axis] = -1 - first
                if first & 128:
                    turn[5 + axis] = first % 32 * BLOCK + int.from_bytes([next(rest) for _ in range(3)], "little")
        yield turn
