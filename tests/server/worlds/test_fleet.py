"""Tests of many processes with many worlds, in simulated time."""

import base64
import contextlib
import random
from typing import Any

import pytest

from server import Player, Rules
from server.worlds.fleet_entries import ProcessEntry, WorldEntry, packed
from server.worlds.kinds import WorldsError
from server.worlds.lease import HOLD_S, LEASE_S
from server.worlds.seats import EXPIRED
from tests.lengths import long
from tests.server.worlds.fleets import Sim, slow_kind


def fleet(seed: int = 1, processes: int = 3, **more: object) -> Sim:
    sim = Sim(seed, slow_kind(players_max=4, empty_s=5.0), **more)  # type: ignore[arg-type]
    for _ in range(processes):
        sim.start()
    sim.run(1.0)
    return sim


def test_a_match_is_the_same_one_at_every_front() -> None:
    sim = fleet()
    visitors = [sim.visit("/match?kind=arena", front=process) for process in sim.processes]
    sim.until(lambda: all(visitor.world for visitor in visitors))
    assert len({visitor.world for visitor in visitors}) == 1
    assert sum(len(process.worlds.worlds) for process in sim.processes) == 1
    sim.run(1.5)
    for process in sim.processes:
        (entry,) = process.worlds.entries()
        assert (entry["name"], entry["players"]) == (visitors[0].world, 3)


def test_worlds_are_made_at_the_process_with_the_least_load() -> None:
    sim = fleet()
    visitors = [sim.visit("/create?kind=arena") for _ in range(12)]
    sim.until(lambda: all(visitor.world for visitor in visitors))
    assert [len(process.worlds.worlds) for process in sim.processes] == [4, 4, 4]


def test_many_clients_at_once_fill_worlds_and_none_is_left_out() -> None:
    sim = fleet()
    visitors = [sim.visit("/match?kind=arena") for _ in range(40)]
    sim.until(lambda: all(visitor.world for visitor in visitors))
    sim.run(1.0)
    players = [world.players for process in sim.processes for world in process.worlds.worlds.values()]
    assert sum(players) == 40
    assert sorted(players) == [4] * 10


def test_a_code_and_a_name_lead_to_their_world_from_any_front() -> None:
    sim = fleet()
    host = sim.visit("/create?kind=arena&private=1")
    sim.until(lambda: bool(host.world))
    (world,) = [world for process in sim.processes for world in process.worlds.worlds.values()]
    sim.run(0.5)
    friends = [sim.visit(f"/join?code={world.code.lower()}", front=process) for process in sim.processes]
    sim.until(lambda: all(friend.world == host.world for friend in friends))
    public = sim.visit("/create?kind=arena")
    sim.until(lambda: bool(public.world))
    named = [sim.visit(f"/{public.world}", front=process) for process in sim.processes]
    sim.until(lambda: all(visitor.world == public.world for visitor in named))
    assert not any(visitor.refused for visitor in (*friends, *named))


def test_a_name_that_does_not_exist_is_refused_soon() -> None:
    sim = fleet()
    lost = sim.visit("/nowhere")
    sim.until(lambda: bool(lost.refused), 1.0)
    assert lost.refused[0] == "there is no world 'nowhere'"


def test_a_killed_process_frees_its_worlds_and_the_players_meet_again() -> None:
    sim = fleet()
    visitors = [sim.visit("/match?kind=arena") for _ in range(4)]
    sim.until(lambda: all(visitor.world for visitor in visitors))
    name = visitors[0].world
    (owner,) = sim.owners(name)
    owner.kill()
    sim.run(LEASE_S / 2)
    assert not sim.owners(name), "its lease has not run out"
    sim.until(lambda: all(visitor.world == name for visitor in visitors), 2 * LEASE_S)
    (other,) = sim.owners(name)
    assert other is not owner
    assert other.worlds.worlds[name].players == 4


@pytest.mark.parametrize("saved", [False, True])
def test_a_world_with_data_comes_up_elsewhere_and_one_without_is_forgotten(saved: bool) -> None:
    sim = fleet(saved=saved)
    visitor = sim.visit("/match?kind=arena")
    sim.until(lambda: bool(visitor.world))
    name = visitor.world
    (owner,) = sim.owners(name)
    sim.run(2.0)
    visitor.leave()
    owner.kill()
    sim.run(LEASE_S + 3.0)
    assert len(sim.owners(name)) == saved
    sim.run(60.0)
    assert not [key for key in sim.keys if ".world." in key], "empty worlds end, and leave nothing behind"


def test_a_suspended_owner_notices_and_its_late_writes_do_not_count() -> None:
    sim = fleet(saved=True)
    visitors = [sim.visit("/match?kind=arena") for _ in range(3)]
    sim.until(lambda: all(visitor.world for visitor in visitors))
    name = visitors[0].world
    (owner,) = sim.owners(name)
    sim.run(2.0)
    owner.stop(20.0)
    for visitor in visitors:
        visitor.cut(owner)
    sim.run(HOLD_S + 0.1)
    assert not sim.owners(name)
    sim.until(lambda: all(visitor.world == name for visitor in visitors), 15.0)
    (other,) = sim.owners(name)
    sim.run(20.0)
    assert sim.owners(name) == [other]
    assert owner.worlds.fleet.counts["leases_lost"] == 1
    assert not owner.worlds.worlds
    assert sim.acknowledged[name] == sim.disk[other.folders[name]]


def test_worlds_stand_still_while_the_bus_is_away_and_go_on_after_it() -> None:
    sim = fleet(saved=True)
    visitors = [sim.visit("/match?kind=arena") for _ in range(8)]
    sim.until(lambda: all(visitor.world for visitor in visitors))
    worlds = {visitor.world: sim.owners(visitor.world) for visitor in visitors}
    sim.bus_up = False
    sim.run(HOLD_S + 3.0)
    assert not any(map(sim.owners, worlds))
    sim.run(10.0)
    sim.bus_up = True
    sim.run(3.0)
    assert {name: sim.owners(name) for name in worlds} == worlds, "nobody took them away meanwhile"
    assert all(visitor.counts["new"] == 1 for visitor in visitors)


def test_a_draining_process_keeps_its_matches_and_gets_no_new_ones() -> None:
    sim = fleet()
    visitor = sim.visit("/match?kind=arena")
    sim.until(lambda: bool(visitor.world))
    (owner,) = sim.owners(visitor.world)
    owner.worlds.draining = True
    sim.run(1.0)
    others = [sim.visit("/create?kind=arena", front=process) for process in sim.processes for _ in range(2)]
    sim.until(lambda: all(other.world for other in others))
    assert [*owner.worlds.worlds] == [visitor.world]


def test_a_released_world_comes_up_elsewhere_at_once() -> None:
    sim = fleet(saved=True)
    visitor = sim.visit("/match?kind=arena")
    sim.until(lambda: bool(visitor.world))
    name = visitor.world
    (owner,) = sim.owners(name)
    owner.worlds.shut_down("the server is going down", 0.5)
    owner.ticking.clear()
    owner.worlds.release()
    sim.until(lambda: not owner.worlds.fleet.busy, 2.0)
    owner.worlds.fleet.leave()
    sim.run(0.3)
    owner.kill()
    sim.until(lambda: bool(sim.owners(name)), 2.0)
    (other,) = sim.owners(name)
    assert other.folders[name] == name, "it was closed properly, so nothing is copied"
    sim.until(lambda: visitor.world == name, 5.0)


@pytest.mark.parametrize(
    "value",
    [
        b"",
        b"{}",
        b"[]",
        b"\xff",
        b"[" * 100_000,
        b'{"owner":1}',
        packed(WorldEntry("x" * 40, "arena", {})),
        packed(WorldEntry("", "ARENA", {})),
        packed(WorldEntry("", "arena", {str(k): k for k in range(100)})),
        packed(WorldEntry("", "arena", {}, folder="../../etc")),
        packed(WorldEntry("", "arena", {}, code="\ud800")),
        packed(ProcessEntry("n", 1, "http://x", False, 1, {}, {})),
        packed(ProcessEntry("n", 1, "ws://x", False, -1, {}, {})),
        packed(ProcessEntry("n", 1, "ws://x", False, 1, {}, {}))[:-2] + b',"a":[NaN]}}',
    ],
    ids=range(14),
)
def test_a_malformed_entry_harms_nobody(value: bytes) -> None:
    sim = fleet()
    visitor = sim.visit("/match?kind=arena")
    sim.until(lambda: bool(visitor.world))
    name = visitor.world
    (owner,) = sim.owners(name)
    for key in ("world.hostile", "process.zzzz", f"world.{name}", "world.", "else", "world.../x", "process."):
        sim.set(f"fleet.test.{key}", value)
    sim.run(3.0)
    assert sim.owners(name) == [owner], "its owner writes the entry again"
    more = [sim.visit("/match?kind=arena", front=process) for process in sim.processes]
    sim.until(lambda: all(each.world for each in more))
    sim.set(f"fleet.test.process.{owner.worlds.fleet.me}", value)
    sim.run(HOLD_S + 0.1)
    sim.until(lambda: all(each.world for each in (visitor, *more)), 40.0)


def course(seed: int, seconds: float, *, saved: bool) -> Sim:
    """Runs a schedule by chance: clients come and go, processes are killed, stopped and started."""
    chance = random.Random(seed)
    sim = fleet(seed, 3, saved=saved, delay_s=chance.choice((0.01, 0.1)), lost=chance.choice((0.0, 0.05)))
    until = sim.now + seconds
    while sim.now < until:
        sim.run(chance.uniform(0.1, 1.5))
        act = chance.random()
        running = [process for process in sim.alive if sim.now >= process.stopped_until]
        if act < 0.5 and len(sim.clients) < 30:
            sim.visit(chance.choice(("/match?kind=arena", "/match?kind=arena", "/create?kind=arena")))
        elif act < 0.6 and sim.clients:
            chance.choice(sim.clients).leave()
        elif act < 0.7 and len(running) > 1:
            chance.choice(running).kill()
            sim.start()
        elif act < 0.8 and len(running) > 1:
            chance.choice(running).stop(chance.uniform(0.5, 15.0))
        elif act < 0.83:
            sim.bus_up = False
            sim.run(chance.uniform(0.5, 8.0))
            sim.bus_up = True
    return sim


@pytest.mark.parametrize("seed", [*range(1, 4), *long(*range(4, 14))])
def test_any_course_of_events_leaves_everybody_in_one_world(seed: int) -> None:
    sim = course(seed, 40.0, saved=seed % 2 == 0)
    sim.run(30.0)
    stay = [client for client in sim.clients if client.first]
    sim.until(lambda: all(client.world for client in stay), 60.0)
    sim.run(10.0)
    for client in stay:
        owners = sim.owners(client.world)
        assert len(owners) == 1, f"{client.name} is in {client.world}"
        inside = [
            (process.number, name)
            for process in sim.alive
            for name, world in process.worlds.worlds.items()
            for player in world.game.players.values()
            if player.name == client.name and player.session is not None and not player.session.closed
        ]
        assert inside == [(owners[0].number, client.world)]
    for client in stay:
        client.leave()
    sim.run(80.0)
    assert not [key for key in sim.keys if ".world." in key], "no entry of a world is left"
    assert len([key for key in sim.keys if ".process." in key]) == len(sim.alive)
    for process in sim.alive:
        assert not process.worlds.worlds
        assert not process.worlds.fleet.mine
        assert not process.worlds.fleet.worlds


@pytest.mark.parametrize("seed", [2, *long(*range(10, 24, 2))])
def test_every_edit_that_was_acknowledged_is_there_once(seed: int) -> None:
    sim = course(seed, 40.0, saved=True)
    sim.until(lambda: all(client.world for client in sim.clients if client.first), 60.0)
    sim.run(12.0)
    for name, edits in sim.acknowledged.items():
        owners = sim.owners(name)
        if owners:
            saved = sim.disk[owners[0].folders[name]]
            assert [edit for edit in saved if edit in set(edits)] == edits
            assert len(set(saved)) == len(saved)


class Hall(Rules):
    """A world whose players are sent to a new one each, with data."""

    def on_join(self, player: Player) -> None:
        self.game.soon(self.send, player)

    def send(self, player: Player) -> None:
        try:
            name = self.game.worlds.create("arena")
            self.game.send_away(player, name, {"gold": 7}, "go")
        except WorldsError as error:
            self.game.kick(player, str(error))


def test_rules_send_players_to_worlds_of_other_processes_with_data() -> None:
    sim = Sim(1, slow_kind(players_max=2), slow_kind("hall", rules=Hall))
    for _ in range(3):
        sim.start()
    sim.run(1.0)
    visitors = [sim.visit("/match?kind=hall") for _ in range(6)]
    sim.until(lambda: all(visitor.world.startswith("arena") for visitor in visitors))
    worlds = [world for process in sim.processes for world in process.worlds.worlds.values()]
    handed = [player.handed for world in worlds for player in world.game.players.values()]
    assert [data for data in handed if data] == [{"gold": 7}] * 6
    at = [sum(name.startswith("arena") for name in process.worlds.worlds) for process in sim.processes]
    assert sum(at) == 6
    assert max(at) < 6, "not all of them are at one process"


def test_data_that_cannot_go_to_another_process_are_an_error_of_the_rules() -> None:
    sim = fleet()
    visitor = sim.visit("/create?kind=arena")
    sim.until(lambda: bool(visitor.world))
    sim.run(1.0)
    (owner,) = sim.owners(visitor.world)
    (front, *_) = [process for process in sim.processes if process is not owner]
    for data in ("x" * 900, object(), 1 << 70):
        with pytest.raises(WorldsError, match="data"):
            front.worlds.seat(visitor.world, "", data, "")
    with pytest.raises(WorldsError, match=r"is at ws://10\.0\.0\.\d:8765; ask there"):
        front.worlds.end(visitor.world, "x")


def test_a_seat_of_another_process_counts_once_and_for_its_time() -> None:
    sim = fleet()
    visitor = sim.visit("/create?kind=arena")
    sim.until(lambda: bool(visitor.world))
    sim.run(1.0)
    (owner,) = sim.owners(visitor.world)
    (front, *_) = [process for process in sim.processes if process is not owner]
    seats = owner.worlds.seats
    go = front.worlds.seat(visitor.world, "ann", {"secret": 1}, "")
    assert go.path.startswith(owner.url)
    token = go.path.partition("seat=")[2]
    assert b"secret" not in base64.urlsafe_b64decode(token.split(".")[1] + "==")
    assert front.worlds.elsewhere(visitor.world).free == 2, "its own seat counts until it is known"  # type: ignore[union-attr]
    seat = seats.take(visitor.world, token, sim.now)
    assert not isinstance(seat, str)
    assert (seat.subject, seat.data) == ("ann", {"secret": 1})
    assert seats.take(visitor.world, token, sim.now) is seat
    sim.run(1.5)
    assert front.worlds.elsewhere(visitor.world).free == 2  # type: ignore[union-attr]
    seat.settled = True
    assert seats.take(visitor.world, token, sim.now) == EXPIRED
    other = front.worlds.seat(visitor.world, "", None, "").path.partition("seat=")[2]
    sim.run(40.0)
    assert seats.take(visitor.world, token, sim.now) == EXPIRED
    assert seats.take(visitor.world, other, sim.now) == EXPIRED
    assert isinstance(seats.take(visitor.world, other[:-2] + "AA", sim.now), str)


class Pairs(Rules):
    """Two players who wait play together."""

    @staticmethod
    def pair(waiting: list[Any]) -> list[Any]:
        return [waiting[at : at + 2] for at in range(0, len(waiting) - 1, 2)]


def test_a_pair_meets_from_two_fronts() -> None:
    sim = Sim(1, slow_kind("duel", rules=Pairs, players_max=2))
    for _ in range(3):
        sim.start()
    sim.run(1.0)
    visitors = [sim.visit("/match?kind=duel", front=sim.processes[at]) for at in (0, 2)]
    sim.until(lambda: all(visitor.world for visitor in visitors))
    assert len({visitor.world for visitor in visitors}) == 1


@pytest.mark.parametrize("by", ["name", "code"])
def test_a_world_that_sleeps_comes_back_with_its_data_at_any_process(by: str) -> None:
    sim = Sim(1, slow_kind(empty_s=1.0, keep=True), saved=True)
    for _ in range(2):
        sim.start()
    sim.run(1.0)
    visitor = sim.visit(f"/create?kind=arena&private={by == 'code':d}")
    sim.until(lambda: bool(visitor.world))
    name = visitor.world
    (owner,) = sim.owners(name)
    code = owner.worlds.worlds[name].code
    sim.run(2.0)
    edits = list(sim.acknowledged[name])
    visitor.leave()
    sim.until(lambda: not sim.owners(name), 10.0)
    owner.kill()
    sim.run(3.0)
    again = sim.visit(f"/join?code={code}" if by == "code" else f"/{name}")
    sim.until(lambda: again.world == name, 5.0)
    (other,) = sim.owners(name)
    assert other is not owner
    assert sim.disk[other.folders[name]][: len(edits)] == edits


def test_named_worlds_begin_once_and_never_end() -> None:
    sim = fleet()
    for process in sim.processes:
        with contextlib.suppress(WorldsError):
            process.worlds.create("arena", name="hall", stays=True)
    sim.run(2.0)
    (owner,) = sim.owners("hall")
    assert sum("hall" in process.worlds.worlds for process in sim.processes) == 1
    sim.run(20.0)
    owner.kill()
    sim.until(lambda: bool(sim.owners("hall")), LEASE_S + 3.0)
    sim.run(1.0)
    (other,) = sim.owners("hall")
    assert other.worlds.worlds["hall"].stays
