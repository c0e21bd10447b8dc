"""Real clients in a fleet in simulated time: they go where the fleet sends them, and follow their world."""

import pytest

from client_sdk import Loopback
from client_sdk.core import Core
from client_sdk.events import Disconnected, Event, Joined, Matched, Resumed
from client_sdk.netsim.links import PRESETS
from server.worlds.host import Way
from shared.fields import split_place
from sovereign_netcode.playtest import wander
from sovereign_netcode.playtest.match import Player, Simulation
from tests.lengths import long
from tests.server.worlds.fleets import Process, Sim, slow_kind

STEP_S = 0.02


class FleetMatch(Simulation):
    """Players with real client cores, and the processes of a fleet."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.fleet = Sim(seed, slow_kind(players_max=4, empty_s=3.0))
        for _ in range(3):
            self.fleet.start()
        self.now = self.fleet.now
        self._step()
        self.run(1.0)

    def _step(self) -> None:
        self.fleet.run(max(0.0, self.now - self.fleet.now))
        self.at(self.now + STEP_S, self._step)

    def join(self, path: str, link: str) -> Player:
        core = Core(f"player {len(self.players)}", patience_s=60.0)
        core.travel.path = path
        player = Player(self, core, PRESETS[link], wander, self.seed * 1000 + len(self.players))
        self.players.append(player)
        self.at(self.now, player.connect)
        return player

    def process_of(self, place: str) -> Process | None:
        url, _ = split_place(place)
        return self.fleet.at_url(url) if url else self.fleet.front()

    def route(self, path: str) -> Way | str:
        process = self.process_of(path)
        return "no server there" if process is None else process.worlds.route(split_place(path)[1])

    def kill(self, process: Process) -> None:
        sessions = [session for world in process.worlds.worlds.values() for session in world.game.sessions]
        for player in self.players:
            if player.session in sessions:
                player.disconnect()
        process.kill()


@pytest.mark.parametrize("link", ["regional", *long("wifi", "far")])
def test_players_follow_their_world_to_another_process(link: str) -> None:
    match = FleetMatch(3)
    players = [match.join("/match?kind=arena", link) for _ in range(4)]
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 10)
    (world,) = {player.core.travel.world for player in players}
    (owner,) = match.fleet.owners(world)
    events: dict[Player, list[Event]] = {player: list(player.events) for player in players}
    for found in events.values():
        assert [type(event) for event in found if isinstance(event, Matched | Joined)] == [Matched, Joined]
    match.run(2.0)
    match.kill(owner)
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 40)
    (other,) = match.fleet.owners(world)
    assert other is not owner
    assert other.worlds.worlds[world].players == 4
    for player in players:
        assert player.core.travel.world == world
        kinds = [type(event) for event in player.events if isinstance(event, Joined | Resumed | Disconnected | Matched)]
        assert kinds.count(Matched) == 1, "the way back is no new match"
        assert kinds[-1] in (Joined, Resumed), "a world without data begins anew, with the same name"
        assert player.core.stats.divergences == 0


def test_a_connection_that_breaks_comes_back_to_the_same_entity() -> None:
    match = FleetMatch(5)
    players = [match.join("/match?kind=arena", "regional") for _ in range(3)]
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 10)
    match.run(2.0)
    for player in players:
        player.disconnect()
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 20)
    for player in players:
        assert type([event for event in player.events if isinstance(event, Joined | Resumed)][-1]) is Resumed
        assert player.core.stats.reconnects >= 1


class Fronts:
    """The processes of a fleet for a `Loopback`."""

    behaviours = ()

    def __init__(self, fleet: Sim) -> None:
        self._fleet, self.due = fleet, fleet.now

    def route(self, path: str, now: float) -> Way | str:
        url, rest = split_place(path)
        process = self._fleet.at_url(url) if url else self._fleet.front()
        return "no server there" if process is None else process.worlds.route(rest)

    def advance(self, now: float) -> None:
        self._fleet.run(max(0.0, now - self._fleet.now))
        self.due = now

    def restart(self, now: float) -> None:
        self.advance(now)


def test_a_loopback_goes_from_server_to_server() -> None:
    fleet = Sim(1, slow_kind())
    for _ in range(3):
        fleet.start()
    fleet.run(1.0)
    loopback = Loopback(Fronts(fleet))
    clients = [loopback.match("arena", name=f"player {at}") for at in range(3)]
    begin = fleet.now
    for step in range(300):
        for client in clients:
            client.poll(begin + step / 60)
            client.update(begin + step / 60)
    assert {client.core.state for client in clients} == {"playing"}
    assert len({client.world for client in clients}) == 1
