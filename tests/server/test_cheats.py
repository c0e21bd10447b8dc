"""Cheats: whatever a client sends, its path is the path of an honest player who sends one input per tick, in time.

This bound is exact. The consumed input is read from each tick's state, and another game gets an honest player who sends
these inputs. Both must be in the same state at every tick. The numbers of the scene bound the path: per tick, per axis,
and upwards.
"""

import itertools
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.config.limits import Limits
from server.players.player import Player
from server.rewind.history import WINDOW_S
from server.rules import Rules
from shared import edits, messages
from shared.bounds import bounds
from shared.fields import INPUT_ROW_BYTES, INPUT_ROWS_MAX, TICK_MAX
from shared.inputs import checked_input, clamp, row
from shared.layout import BUTTONS, CELL, MOVE_X, VZ, X, Y, Z
from shared.messages import Bye, Command, Hello, Inputs, Message, Ping, Restart, Resync, Welcome, encode
from shared.units import BLOCK
from tests.lengths import examples
from tests.server.test_commands import verdicts
from tests.tables import HELLO, FakeLink, Table, order

State = tuple[int, ...]

RATE = 64
AHEAD_MAX, REPEATS_MAX = bounds(RATE).ahead, bounds(RATE).repeats
WALK = 3 * BLOCK // RATE
"""Maximum distance of a tick along one axis, in grid steps: 3 blocks/s at 64 ticks/s, without a remainder."""
APEX = 2 * BLOCK
"""Height of a jump of 8 blocks/s against 16 blocks/s^2, in grid steps."""
HEIGHT = 7 * BLOCK // 4
EAST, JUMP = bytes((127, 0, 0)), bytes((127, 0, 1))


def plain(rules: Rules | None = None, limits: Limits | None = None, *, aim: bool = False) -> Table:
    """Returns a plain of 64 x 64 blocks around its spawn. A lost player has 5 s to reconnect."""
    return Table(
        limits,
        [[-32, -32, 0, 32, 32, 1, 1]],
        rules,
        resume_s=5.0,
        origin=(-1, -1, -1),
        size=(2, 2, 2),
        spawns=((0.0, 0.0, 1.0),),
        aim=aim,
    )


def state(table: Table, entity: int) -> State:
    return table.game.world.state(entity)[:CELL]


def ahead(table: Table, row: bytes, n: int = 1) -> Inputs:
    """Returns a message of `n` inputs for the coming ticks."""
    return Inputs(table.tick_number + 1, table.tick_number, row * n)


class Cheat:
    """A client that sends what a test wants. Its path is recorded."""

    def __init__(self, table: Table) -> None:
        self.table = table
        self.link = table.join()
        self.entity = self.link.session.entity
        self.path = [state(table, self.entity)]

    def tick(self, n: int = 1) -> None:
        for _ in range(n):
            self.table.tick()
            self.path.append(state(self.table, self.entity))

    def cut_off(self) -> None:
        """Loses the connection and reconnects with the token."""
        self.table.lose(self.link)
        self.take_over()

    def take_over(self) -> None:
        """Reconnects while the old connection still exists."""
        welcome: Welcome = self.link.got(Welcome)[-1]
        self.link = self.table.connect(Hello(messages.VERSION, {}, "", resume=welcome.resume))
        self.tick()
        assert self.link.session.entity == self.entity

    def prove(self) -> None:
        """Checks the path: it is within the bounds, and an honest player with the same inputs walks it, too."""
        table = plain()
        honest = table.join()
        entity = honest.session.entity
        assert state(table, entity) == self.path[0]
        ground = self.path[0][Z]
        for before, after in itertools.pairwise(self.path):
            assert abs(after[X] - before[X]) <= WALK
            assert abs(after[Y] - before[Y]) <= WALK
            assert after[Z] <= ground + APEX
            consumed = checked_input(tuple(after[MOVE_X : BUTTONS + 1]), "input")
            assert clamp(consumed) == consumed
            honest.say(ahead(table, row(consumed)))
            table.tick()
            assert state(table, entity) == after
        assert table.game.counters.kicked == 0

    def walked(self) -> int:
        """Returns how far east the player has gone, in grid steps."""
        return self.path[-1][X] - self.path[0][X]


@pytest.fixture
def cheat() -> Cheat:
    return Cheat(plain())


# -- inputs --------------------------------------------------------------------------------------------------


def test_an_honest_player_walks_at_full_speed(cheat: Cheat) -> None:
    for _ in range(64):
        cheat.link.say(ahead(cheat.table, EAST))
        cheat.tick()
    assert cheat.walked() == 64 * WALK
    cheat.prove()


def test_inputs_from_the_future_are_consumed_in_their_ticks_and_not_before(cheat: Cheat) -> None:
    for _ in range(32):
        cheat.link.say(ahead(cheat.table, EAST, INPUT_ROWS_MAX))
        cheat.link.say(Inputs(cheat.table.tick_number + 1000, -1, EAST * INPUT_ROWS_MAX))
        cheat.tick()
    assert cheat.walked() <= 32 * WALK
    cheat.prove()


def test_late_inputs_are_not_made_up_for(cheat: Cheat) -> None:
    cheat.tick(100)
    cheat.link.say(Inputs(1, 0, EAST * INPUT_ROWS_MAX))
    cheat.tick(100)
    assert cheat.walked() == REPEATS_MAX * WALK, "the newest input is repeated, as for any player"
    cheat.prove()


def test_duplicates_and_several_inputs_for_one_tick_count_once(cheat: Cheat) -> None:
    for _ in range(32):
        for packed in (EAST, EAST, JUMP, bytes((0, 127, 0))):
            cheat.link.say(ahead(cheat.table, packed))
        cheat.tick()
    assert cheat.walked() == 32 * WALK
    assert {seen[Y] for seen in cheat.path} == {0}
    cheat.prove()


def test_a_flood_of_inputs_ends_the_player_and_gains_nothing_until_then(cheat: Cheat) -> None:
    for _ in range(8):
        cheat.link.say(*[ahead(cheat.table, EAST, INPUT_ROWS_MAX)] * 30)
        cheat.tick()
    assert cheat.walked() == 8 * WALK
    cheat.prove()
    cheat.link.say(*[ahead(cheat.table, EAST, INPUT_ROWS_MAX)] * 600)
    assert cheat.link.refusal() == (messages.MALFORMED, "too many messages")
    cheat.table.tick()
    assert cheat.entity not in cheat.table.game.world


@pytest.mark.parametrize("withheld", [1, REPEATS_MAX, REPEATS_MAX + 1, 64, 5 * RATE])
def test_a_lag_switch_loses_what_it_withholds(cheat: Cheat, withheld: int) -> None:
    began = cheat.table.tick_number
    cheat.link.say(ahead(cheat.table, EAST))
    cheat.tick(1 + withheld)
    repeated = min(withheld, REPEATS_MAX)
    assert cheat.walked() == (1 + repeated) * WALK
    for first in range(began + 2, began + 2 + withheld, INPUT_ROWS_MAX):  # all of them at once
        n = min(INPUT_ROWS_MAX, began + 2 + withheld - first)
        cheat.link.say(Inputs(first, began, EAST * n))
    cheat.link.say(ahead(cheat.table, EAST, 8))
    cheat.tick(8)
    assert cheat.walked() == (1 + repeated + 8) * WALK, "only the ticks that were still to come count"
    cheat.prove()


def test_directions_that_are_too_long_are_shortened(cheat: Cheat) -> None:
    for packed in (bytes((127, 127, 0)), bytes((128, 128, 0)), bytes((128, 0, 255)), bytes((129, 127, 254))):
        cheat.link.say(ahead(cheat.table, packed, 16))
        cheat.tick(16)
    for before, after in itertools.pairwise(cheat.path):
        step = (after[X] - before[X], after[Y] - before[Y])
        assert step[0] ** 2 + step[1] ** 2 <= WALK**2
    cheat.prove()


def test_there_is_no_jump_in_the_air(cheat: Cheat) -> None:
    jumps = 0
    for _ in range(3 * RATE):
        cheat.link.say(ahead(cheat.table, JUMP))
        on_ground = cheat.path[-1][Z] == cheat.path[0][Z]
        cheat.tick()
        if cheat.path[-1][VZ] > cheat.path[-2][VZ]:
            jumps += 1
            assert on_ground or cheat.path[-1][Z] == cheat.path[0][Z], "the player rose faster in mid-air"
    assert jumps >= 3
    cheat.prove()


# -- teleporting ---------------------------------------------------------------------------------------------

WHOLES = (0, 1, 127, 128, 1 << 31, (1 << 32) - 1, TICK_MAX)
NUMBERS = (0, -1, 0.0, -0.0, 1e300, -1e300, 5e-324, (1 << 64) - 1, -(1 << 63))
BLOBS = (b"", bytes(1), b"\xff" * 1024, b"\xdd\xff\xff\xff\xff", b"\x94\xd3\x80\0\0\0\0\0\0\0\0\0\0", b"\x93\0\0\0")
PLACES = (0, 1, -1, (1 << 28) - 1, -(1 << 28), 1 << 28, (1 << 63) - 1, -(1 << 63))


def extremes() -> list[Message]:
    """Returns messages of every kind that a client may send, with the least, the greatest and the oddest values in each
    field."""
    found: list[Message] = [Resync(), Bye(0, "", -1e300), Bye(4999, "x" * 500, 1e300)]
    found += [Hello(v, {}, "n" * 32, "t" * 2048, r) for v in (0, 1, 1 << 31) for r in (b"", bytes(16), b"\xff" * 16)]
    found += [
        Inputs(first, acked, row * n)
        for first in (*WHOLES[:-1], TICK_MAX - INPUT_ROWS_MAX)
        for acked in (-1, *WHOLES)
        for row in (b"\x7f\x7f\xff", b"\x80\x80\xff")
        for n in (0, 1, INPUT_ROWS_MAX)
    ]
    found += [Ping(sent, corrections) for sent in NUMBERS for corrections in (0, (1 << 32) - 1)]
    names = (edits.NAME, "teleport", "place", "set_velocity", "")
    payloads = (*BLOBS, *(edits.pack(edits.Edit(x, y, 1, 255)) for x in PLACES for y in PLACES))
    found += [
        Command(1 + i, tick, seen, name, payload)
        for i, (tick, seen, name, payload) in enumerate(
            itertools.product((-1, 0, TICK_MAX), (-1e300, 0, 1e300), names, payloads)
        )
    ]
    return found


def test_no_message_of_any_kind_moves_anybody() -> None:
    """One connection per kind of message; some messages close it. Neither the sender nor the player beside it leaves
    the bounds."""
    for kind, group in itertools.groupby(extremes(), type):
        table = plain(limits=Limits(edits_per_s=10_000))
        bystander = table.join().session.entity
        cheat = Cheat(table)
        still = state(table, bystander)
        for message in group:
            if cheat.link.session.closed:
                break
            cheat.link.say(message)
            if not cheat.link.session.closed:
                cheat.tick()
        assert state(table, bystander) == still, kind
        for before, after in itertools.pairwise(cheat.path):
            assert abs(after[X] - before[X]) <= WALK, kind
            assert abs(after[Y] - before[Y]) <= WALK, kind
            assert cheat.path[0][Z] <= after[Z] <= cheat.path[0][Z] + HEIGHT + APEX, kind  # off the bystander


def test_each_message_of_the_server_ends_the_client_that_sends_it() -> None:
    for message in (
        Welcome(messages.VERSION, 1, 1, {}),
        messages.Snapshot(1, 1, b"", 1, b"", b"", b"", ([0, 0, 0, -1, b"", bytes(33), b"", 0, b"", []],)),
        messages.Terrain(0, 0, 0, 0, 1, b"\1"),
        messages.Pong(0.0, 1e9),
        messages.Happened(1, "x", b""),
        messages.Shared({"score": 1}),
    ):
        table = plain()
        link = table.join()
        before = table.game.world.state_hash()
        link.say(encode(message))
        assert link.refusal()[0] == messages.MALFORMED
        assert table.game.world.state_hash() == before


# -- edits ---------------------------------------------------------------------------------------------------


def done(link: FakeLink) -> int:
    return sum(verdict == messages.DONE for verdict in verdicts(link).values())


def test_edits_out_of_reach_are_refused_whatever_tick_they_name(cheat: Cheat) -> None:
    cheat.tick(128)
    reach = int(cheat.table.game.scene.reach)
    cells = [(reach, 0, 1), (-reach - 1, 0, 1), (0, reach, 1), (0, 0, reach + 1), (1 << 27, 0, 1), (5, 5, 5)]
    ticks = (-1, 0, cheat.table.tick_number, cheat.table.tick_number + AHEAD_MAX)
    orders = [order(i, tick, *cell, 5) for i, (tick, cell) in enumerate(itertools.product(ticks, cells), 1)]
    for each in orders:
        cheat.link.say(each)
        cheat.tick(8)
    cheat.tick(AHEAD_MAX)
    assert set(verdicts(cheat.link).values()) == {messages.OUT_OF_REACH}
    assert len(verdicts(cheat.link)) == len(orders)


def test_a_block_into_a_player_is_refused_and_moves_no_player(cheat: Cheat) -> None:
    cheat.tick(128)
    inside = [(0, 0, 1), (0, 0, 2)]  # the box of 5/8 x 5/8 x 7/4 at (0, 0, 1)
    for number, cell in enumerate(inside, 1):
        cheat.link.say(order(number, 0, *cell, 5))
        cheat.tick(2)
    assert list(verdicts(cheat.link).values()) == [messages.OVERLAPS] * 2
    assert len({seen[X : Z + 1] for seen in cheat.path}) == 1


def edit_all(table: Table, link: FakeLink, number: int, ticks: int, per_tick: int = 4) -> int:
    """Sends edits much faster than allowed. Returns the next number."""
    for _ in range(ticks):
        for _ in range(per_tick):
            link.say(order(number, 0, 3, number % 5 - 2, 1, number % 255 + 1))
            number += 1
        table.tick()
    return number


def test_edits_that_come_too_fast_are_refused(cheat: Cheat) -> None:
    cheat.tick(4 * RATE)
    edit_all(cheat.table, cheat.link, 1, 2 * RATE)
    rate = cheat.table.game.limits.edits_per_s
    assert done(cheat.link) == 2 * rate + 2 * rate - 1, "the burst, and two seconds of edits without the last tick's"


def test_a_reconnect_gives_no_edits(cheat: Cheat) -> None:
    rate = cheat.table.game.limits.edits_per_s
    links, number = [cheat.link], 1
    began = cheat.table.tick_number
    for i in range(40):
        number = edit_all(cheat.table, cheat.link, number, 2)
        cheat.tick()
        (cheat.cut_off if i % 2 else cheat.take_over)()
        links.append(cheat.link)
    seconds = (cheat.table.tick_number - began) / RATE
    assert sum(map(done, links)) <= rate * seconds + 1


def test_leaving_and_joining_anew_gives_no_edits() -> None:
    table = plain()
    began, total = table.tick_number, 0
    for _ in range(40):
        link = table.join()
        edit_all(table, link, 1, 2)
        table.tick()
        total += done(link)
        link.say(Bye(0, "", -1.0))
        table.lose(link)
    assert total <= table.game.limits.edits_per_s * (table.tick_number - began) / RATE


# -- coming back ---------------------------------------------------------------------------------------------


def test_of_two_connections_only_the_newer_one_counts(cheat: Cheat) -> None:
    old = cheat.link
    cheat.take_over()
    for _ in range(16):
        old.say(ahead(cheat.table, EAST, 8))
        cheat.link.say(ahead(cheat.table, bytes((0, 127, 0))))
        cheat.tick()
    assert cheat.walked() == 0
    assert cheat.path[-1][Y] == 16 * WALK
    cheat.prove()


def test_a_token_used_by_two_at_once_gives_one_entity() -> None:
    table = plain()
    link = table.join()
    hello = Hello(messages.VERSION, {}, "", resume=link.got(Welcome)[-1].resume)
    twins = [table.connect(hello) for _ in range(5)]
    table.tick()
    mine = [each for each in twins if each.session.entity == link.session.entity]
    assert sum(not each.session.closed for each in mine) == 1
    for each in twins:
        each.say(*[] if each.session.closed else [ahead(table, EAST)])
    x = state(table, link.session.entity)[X]
    table.tick()
    assert state(table, link.session.entity)[X] - x <= WALK


def test_quick_reconnects_give_no_inputs(cheat: Cheat) -> None:
    ticks = cheat.table.tick_number
    for i in range(60):
        cheat.link.say(ahead(cheat.table, EAST, 8))
        (cheat.cut_off if i % 2 else cheat.take_over)()
    assert cheat.walked() <= (cheat.table.tick_number - ticks) * WALK
    cheat.prove()


def test_pending_verdicts_of_a_client_that_never_reads_are_bounded_over_reconnects(cheat: Cheat) -> None:
    player = cheat.table.game.players[cheat.entity]
    resume = cheat.link.got(Welcome)[-1].resume
    longest = 0
    for _ in range(6):
        cheat.link.waiting = 1 << 20
        for _ in range(40):
            cheat.link.say(*[order(1, 0, 3, 0, 1, 5)] * 8)  # carried out once, and asked for again and again
            cheat.table.tick()
        longest = max(longest, len(player.verdicts))
        cheat.table.lose(cheat.link)
        cheat.link = cheat.table.connect(Hello(messages.VERSION, {}, "", resume=resume))
        cheat.link.waiting = 1 << 20
        cheat.table.tick()
        assert cheat.link.session.entity == cheat.entity
    assert longest < 2 * 40 * 8, "the verdicts of the last connection, and those kept of the one before"


# -- the view tick -------------------------------------------------------------------------------------------


class Asking(Rules):
    """Rules that look up how far back lag compensation goes for the view tick of a command."""

    def __init__(self) -> None:
        self.granted: list[float] = []

    def on_command(self, player: Player, name: str, payload: Any) -> bool | None:
        self.granted.append(self.game.tick - 1 - self.game.rewound(player).seen)
        return None


@pytest.mark.parametrize("seen", [0, -1, -(1 << 63), -1e300, 5e-324, 1e300, (1 << 64) - 1, 10_000.5])
def test_a_false_view_tick_is_limited_to_the_last_half_second(seen: float) -> None:
    rules = Asking()
    cheat = Cheat(plain(rules))
    cheat.tick(100)
    cheat.link.say(Command(1, 0, seen, "shoot", b"\xc0"))
    cheat.tick()
    (ago,) = rules.granted
    assert ago == (RATE * WINDOW_S if seen < 100 else 0.0)


# -- any schedule --------------------------------------------------------------------------------------------

ROWS = st.binary(min_size=0, max_size=12 * INPUT_ROW_BYTES).map(lambda data: data[: len(data) // 3 * 3])
OFFSETS = st.one_of(
    st.integers(-12, 12), st.sampled_from([-400, -65, AHEAD_MAX - 1, AHEAD_MAX, AHEAD_MAX + 1, 1 << 40])
)
ACTS = st.one_of(
    st.tuples(st.just("inputs"), OFFSETS, ROWS),
    st.tuples(st.just("inputs"), st.just(1), st.sampled_from([EAST, JUMP, b"\x80\x80\xff"])),
    st.tuples(st.just("wait"), st.integers(0, 24), st.just(b"")),
    st.tuples(st.just("restart"), OFFSETS, st.just(b"")),
    st.tuples(st.sampled_from(["cut off", "take over", "resync", "ping", "order"]), st.just(0), st.just(b"")),
)


@settings(max_examples=examples(60))
@given(st.lists(ACTS, max_size=60), st.sampled_from([b"", bytes(6), b"\x00\x80" * 3, b"\xff\x7f\x01\x00\x00\x80"]))
def test_any_schedule_comes_to_an_honest_path(schedule: list[tuple[str, int, bytes]], aim: bytes) -> None:
    """Plays in scenes with and without aim. An aim, of whatever length, does not change the path."""
    cheat = Cheat(plain(aim=aim != b""))
    for what, number, rows in schedule:
        match what:
            case "inputs":
                packed = b"".join(rows[at : at + INPUT_ROW_BYTES] + aim for at in range(0, len(rows), INPUT_ROW_BYTES))
                cheat.link.say(Inputs(max(0, cheat.table.tick_number + number), -1, packed))
                if number % 2:
                    continue  # more messages in the same tick
            case "wait":
                cheat.tick(number)
            case "restart":
                cheat.link.say(Restart(max(0, cheat.table.tick_number + number)))
                if number % 2:
                    continue
            case "cut off":
                cheat.cut_off()
            case "take over":
                cheat.take_over()
            case "resync":
                cheat.link.say(Resync())
            case "ping":
                cheat.link.say(Ping(1e300))
            case "order":
                cheat.link.say(Command(0, 0, 1e300, "teleport", b"\x93\0\0\0"))
        cheat.tick()
    cheat.tick(REPEATS_MAX + 2)
    cheat.prove()


def test_the_plain_is_what_the_bounds_say() -> None:
    template = next(t for t in plain().game.scene.templates if t.name == "box")
    scene = plain().game.scene
    assert template.walk_speed * BLOCK == WALK * scene.tick_rate
    assert template.jump_speed**2 / (2 * scene.gravity) * BLOCK == APEX
    assert HELLO.version == messages.VERSION
