"""Several worlds within the program: matches, friends, codes, and rules that send their players on."""

from typing import Any

import pytest

from client_sdk import Client, Event, Joined, Left, Loopback, Matched, Moved, Resumed, Waiting
from client_sdk.loopback import LEAP_S
from server import Game, Player, Rules
from server.worlds.kinds import kind_of
from shared.scene import load_scene
from sovereign_netcode.playtest import LocalWorlds

FLAT = load_scene("flat")
FRAME_S = 1 / 64


class Hall(Rules):
    """Sends a player to an arena that it makes."""

    def on_command(self, player: Player, name: str, data: Any) -> bool | str | None:
        if name == "arena":
            made = self.game.worlds.create("arena", stage="final")
            self.game.send_away(player, made, {"gold": 7}, "the final begins")
        return True


class Program:
    """A loop over the clients of a loopback, in simulated time."""

    def __init__(self, *kinds: Any, **more: Any) -> None:
        self.worlds = LocalWorlds(*kinds, **more)
        self.loopback = Loopback(self.worlds)
        self.events: dict[Client, list[Event]] = {}
        self.now = 1000.0

    def add(self, client: Client) -> Client:
        self.events[client] = []
        return client

    def match(self, **more: Any) -> Client:
        return self.add(self.loopback.match("arena", **more))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / FRAME_S)):
            self.now += FRAME_S
            for client in self.events:
                self.events[client] += client.poll(self.now)
                client.set_input(1, 0)
                client.update(self.now)

    def kinds(self, client: Client, *kinds: type) -> list[Event]:
        return [event for event in self.events[client] if isinstance(event, kinds)]


def arena(**limits: Any) -> Any:
    return kind_of("arena", Rules, FLAT, **limits)


@pytest.mark.parametrize("link", [None, "regional"])
def test_two_meet_in_a_match_and_a_third_gets_a_world_of_its_own(link: str | None) -> None:
    program = Program(arena(players_max=2))
    clients = [program.match(name=f"player {k}", mode="ffa", link=link) for k in range(3)]
    program.run(3)
    assert [client.playing for client in clients] == [True] * 3
    assert [client.world for client in clients] == ["arena-1", "arena-1", "arena-2"]
    for client in clients:
        found = program.kinds(client, Waiting, Matched, Moved, Joined, Left)
        assert [type(event) for event in found] == [Matched, Joined]
        assert client.stats.corrections == client.stats.divergences == 0
    assert [len(client.view(program.now).others) for client in clients] == [1, 1, 0]
    assert {name: world.game.world.tick > 60 for name, world in program.worlds.core.worlds.items()} == {
        "arena-1": True,
        "arena-2": True,
    }


def test_a_private_world_its_code_and_its_seats() -> None:
    program = Program(arena(players_max=3))
    host = program.add(program.loopback.create("arena", private=True, map="island"))
    program.run(1)
    assert host.playing
    assert len(host.code) == 6
    (world,) = program.worlds.core.entries(named=True)
    assert (world["code"], world["properties"]) == (host.code, {"map": "island"})
    friend = program.add(program.loopback.join("Bob", code=host.code.lower()))
    stranger = program.add(program.loopback.join("Eve", world=host.world))
    program.run(1)
    assert (friend.playing, friend.world, friend.code) == (True, host.world, host.code)
    (left,) = program.kinds(stranger, Left)
    assert isinstance(left, Left)
    assert "private" in left.reason


def test_friends_take_the_seats_that_one_of_them_reserved() -> None:
    program = Program(arena(players_max=3))
    first = program.match(seats=3)
    program.run(1)
    assert len(first.seats) == 2
    friends = [program.add(program.loopback.join(seat=seat)) for seat in first.seats]
    other = program.match()
    program.run(1)
    assert [client.world for client in (first, *friends, other)] == ["arena-1"] * 3 + ["arena-2"]
    late = program.add(program.loopback.join(seat=first.seats[0]))
    program.run(1)
    (left,) = program.kinds(late, Left)
    assert isinstance(left, Left)
    assert "the seat has expired" in left.reason


def test_those_who_find_no_world_wait() -> None:
    program = Program(arena(players_max=1, worlds_max=1, empty_s=1))
    first, second = program.match(), program.match()
    program.run(7)
    waits = program.kinds(second, Waiting)
    assert 2 <= len(waits) <= 4
    assert [(wait.position, wait.waiting) for wait in waits if isinstance(wait, Waiting)] == [(1, 1)] * len(waits)
    assert (second.joining, second.world) == (True, "")
    first.close()
    program.run(3)
    assert second.playing


def test_the_rules_send_a_player_on_with_what_it_carries() -> None:
    program = Program(arena(), default=Game(FLAT, rules=Hall()))
    client = program.add(program.loopback.join("Ann"))
    program.run(1)
    assert (client.playing, client.world) == (True, "")
    hall = client.entity
    client.command("arena")
    program.run(2)
    moves = program.kinds(client, Moved, Joined)
    assert [type(event) for event in moves] == [Joined, Moved, Joined]
    assert moves[1] == Moved("arena-1", "the final begins")
    assert (client.playing, client.world) == (True, "arena-1")
    game = program.worlds.core.worlds["arena-1"].game
    (player,) = game.players.values()
    assert player.handed == {"gold": 7}
    assert program.worlds.core.default is not None
    assert hall not in program.worlds.core.default.world
    assert client.stats.divergences == 0


def test_an_empty_world_rests_and_ends_and_the_program_may_stand_still() -> None:
    program = Program(arena(empty_s=5))
    client = program.match()
    program.run(1)
    game = program.worlds.core.worlds["arena-1"].game
    program.now += LEAP_S + 1
    before = game.world.tick
    program.run(0.5)
    assert game.world.tick <= before + 0.6 * FLAT.tick_rate, "the missed ticks are dropped"
    program.run(1)
    assert [type(event) for event in program.kinds(client, Joined, Resumed)] == [Joined, Resumed]
    assert client.world == "arena-1"
    client.close()
    bystander = program.add(program.loopback.join(world="arena-9"))
    program.run(1)
    assert "there is no world 'arena-9'" in str(program.kinds(bystander, Left))
    ticks = game.world.tick
    other = program.match(mode="keeps the clock going")
    program.run(4)
    assert game.world.tick == ticks
    program.run(2)
    assert list(program.worlds.core.worlds) == ["arena-2"]
    assert other.playing


def test_ticks_of_worlds_do_not_fall_together() -> None:
    program = Program(arena(players_max=1))
    clients = [program.match() for _ in range(8)]
    program.run(1)
    assert all(client.playing for client in clients)
    tick_s = 1 / FLAT.tick_rate
    dues = sorted(rhythm.due % tick_s for name, rhythm in program.worlds._rhythms.items() if name != "*")
    gaps = [after - before for before, after in zip(dues, [*dues[1:], dues[0] + tick_s], strict=True)]
    assert min(gaps) > tick_s / 20


def test_what_is_no_game_is_refused() -> None:
    for wrong in (LocalWorlds, Game, None, 5):
        with pytest.raises(ValueError, match="must be a `Game` or `LocalWorlds`"):
            Loopback(wrong)  # type: ignore[arg-type]


def test_two_kinds_have_two_names() -> None:
    with pytest.raises(ValueError, match="kinds = arena, arena: must have different names"):
        LocalWorlds(arena(), arena())
