"""Hundreds of clients that come and go; floods, forged seats and foreign codes; many worlds one after another."""

import gc
import random
from collections import Counter
from typing import Any

import pytest

from server.config.limits import Limits
from server.worlds.seats import Seats
from shared import messages
from shared.messages import Bye
from tests.lengths import contained, long
from tests.server.worlds.hosts import Peer, Server, kind


class Visitor:
    """A client by a seeded schedule: it comes, plays for some time, loses its connection at times, and leaves."""

    def __init__(self, server: Server, number: int, chance: random.Random) -> None:
        self.server, self.name, self.chance = server, f"v{number}", chance
        self.lobby: Peer | None = None
        self.peer: Peer | None = None
        self.joined = 0
        self.leaves_at = 0.0

    def act(self) -> None:
        """Does the next thing."""
        peer, lobby = self.peer, self.lobby
        if peer is not None and peer.over is None:
            if peer.welcome is None:
                return
            self.joined += 1
            if self.chance.random() < 0.3:  # a lost connection: back to the same entity
                peer.lose()
                back = Peer(
                    self.server, f"/{peer.path[1:].partition('?')[0]}", name=self.name, resume=peer.welcome.resume
                )
                assert not back.refused
                self.peer = back
            elif self.chance.random() < 0.5:
                peer.send(Bye(messages.GOING_AWAY, "", -1.0))
                self.peer = None
            return
        assert peer is None, peer.over
        if lobby is None:
            mode = self.chance.choice(("", "&mode=a", "&mode=b"))
            self.lobby = Peer(self.server, f"/match?kind=arena{mode}", name=self.name)
        elif lobby.over is not None:
            self.peer, self.lobby = Peer(self.server, lobby.go.path, name=self.name), None
            assert not self.peer.refused


@pytest.mark.parametrize(
    ("clients", "seconds"), [(100, 6), pytest.param(400, 5, marks=[pytest.mark.slow, pytest.mark.longest])]
)
def test_nobody_is_lost_and_no_seat_is_taken_twice(clients: int, seconds: int) -> None:
    chance = random.Random(7)
    server = Server(kind(players_max=4, empty_s=2), limits=Limits(creations_per_s=1000, joins_per_tick=100))
    visitors = [Visitor(server, number, chance) for number in range(clients)]
    for _ in range(seconds * 4):
        for visitor in chance.sample(visitors, clients // 3):
            visitor.act()
        server.run(0.25)
        for world in server.worlds.worlds.values():
            names = Counter(player.name for player in world.game.players.values())
            assert max(names.values(), default=1) == 1
            assert 0 <= world.free <= 4
            assert world.players <= 4
    for _ in range(4):  # those that have not come yet
        for visitor in visitors:
            if not visitor.joined:
                visitor.act()
        server.run(0.5)
    assert all(visitor.joined for visitor in visitors)
    for visitor in visitors:
        for each in (visitor.peer, visitor.lobby):
            if each is not None and each.over is None:
                each.send(Bye(messages.GOING_AWAY, "", -1.0))
    server.run(40)
    assert not server.worlds.worlds
    assert not len(server.worlds.seats)
    assert not server.worlds.lobby.sessions
    counts = Counter(what for what, _ in server.host.done)
    assert counts["begin"] == counts["ended"] == server.worlds.counts["created"] > clients // 8
    assert counts["wake"] == counts["rest"]
    assert server.worlds.faults.total == 0


def growing() -> list[tuple[str, int]]:
    """Returns the numbers of objects of our own types."""
    gc.collect()
    counts = Counter(
        type(each).__qualname__ for each in gc.get_objects() if str(type(each).__module__).startswith("server.")
    )
    return sorted(counts.items())


@pytest.mark.parametrize("rounds", [*contained(60), *long(500)])
def test_no_world_leaks(rounds: int) -> None:
    server = Server(kind(players_max=2, empty_s=0), limits=Limits(creations_per_s=1000))

    def once() -> None:
        peer = server.play("/match?kind=arena")
        server.run(0.1)
        peer.send(Bye(messages.GOING_AWAY, "", -1.0))
        server.run(0.2)
        assert not server.worlds.worlds
        server.host.done.clear()

    for _ in range(5):
        once()
    before = growing()
    for _ in range(rounds):
        once()
    assert growing() == before


def test_a_flood_of_requests_is_bounded() -> None:
    server = Server(kind(), limits=Limits(worlds_max=50, creations_per_s=2, asks_per_s=1))
    answers = Counter[str]()
    for _ in range(200):
        answers["open" if server.worlds.may_ask("/create?kind=arena", "192.0.2.7") else "refused"] += 1
    assert answers == {"open": 10, "refused": 190}
    assert server.worlds.may_ask("/arena-1?seat=x", "192.0.2.7")
    for number in range(5000):  # more addresses than are counted
        server.worlds.may_ask("/join?code=AAAAAA", f"2001:db8:{number:x}::1")
    assert len(server.worlds._asked) <= 4096
    peers = [server.peer("/create?kind=arena") for _ in range(100)]
    made = [peer for peer in peers if peer.over == (1000, "")]
    assert len(made) == len(server.worlds.worlds) == 4  # those of two seconds
    assert {peer.over for peer in peers if peer not in made} == {
        (messages.NOT_ADMITTED, "too many worlds are being made; try again in a second")
    }
    waiting = [server.peer("/match?kind=arena&seats=16") for _ in range(100)]
    server.run(30)
    assert len(server.worlds.worlds) <= 50
    assert sum(peer.over is None for peer in waiting) + sum(peer.over == (1000, "") for peer in waiting) == 100


@pytest.mark.parametrize(
    "path",
    [
        "/create",
        "/create?kind=castle",
        "/match?kind=arena&seats=0",
        "/match?kind=arena&seats=65",
        "/match?kind=arena&seats=1e1",
        "/match?kind=arena&seats=17",
        "/match?kind=arena&a=1&a=2",
        "/match?kind=arena&" + "&".join(f"p{k}=1" for k in range(20)),
        "/match?kind=arena&" + "&".join(f"p{k}=1" for k in range(30)),
        "/match?kind=arena&p=" + "x" * 65,
        "/match?kind=arena&=1",
        "/match?kind=arena&%",
        "/join",
        "/join?code=AAAAAA",
        "/join?code=%00",
        "/arena-9",
        "/../arena-1",
        "/arena-1/x",
        "//",
        "/" + "a" * 5000,
        "/ä",
    ],
)
def test_a_path_that_leads_nowhere_is_refused_with_a_reason(path: str) -> None:
    server = Server(kind(), kind("castle2"))
    server.worlds.create("arena", private=True)
    peer = server.peer(path)
    reason = peer.refused or (peer.over or ("", ""))[1]
    assert reason
    assert len(server.worlds.worlds) == 1
    assert server.worlds.faults.total == 0


def test_seats_that_are_forged_foreign_or_another_player_s() -> None:
    server = Server(kind(), authenticate=lambda token: token)
    world = server.worlds.create("arena")
    other = server.worlds.create("arena")
    foreign = Seats(b"another key of another process..", 30).reserve(world.name, "", None, server.now)
    anns = server.peer("/match?kind=arena", token="ann").go.path
    assert anns.startswith(f"/{world.name}?")
    token = anns.partition("=")[2]
    refused: dict[str, Any] = {
        f"/{world.name}?seat={foreign}": "this is no seat of this server",
        f"/{world.name}?seat=": "this is no seat of this server",
        f"/{world.name}?seat={token[:-2]}AA": "this is no seat of this server",
        f"/{world.name}?seat={'.'.join(token.split('.')[:2])}.": "this is no seat of this server",
        f"/{other.name}?seat={token}": "the seat is in another world",
    }
    for path, reason in refused.items():
        assert server.peer(path, token="ann").refused == reason
    bob = server.peer(anns, token="bob")
    server.run(0.3)
    assert bob.over == (messages.NOT_ADMITTED, "the seat is another player's")
    ann = server.peer(anns, token="ann")
    server.run(0.3)
    assert ann.welcome is not None
    ann.send(messages.Inputs(0, world.game.world.tick, b""))  # it has a snapshot
    for path in (anns, anns):
        assert server.peer(path, token="ann").refused == "the seat has expired; ask for a match again"
        ann.lose()
    assert server.worlds.counts["seats_refused"] == 7


def test_a_seat_counts_again_if_the_welcome_is_lost() -> None:
    server = Server(kind(players_max=1))
    go = server.peer("/match?kind=arena").go
    first = server.peer(go.path)
    assert server.peer(go.path).refused == "the seat is in use"
    first.lose()  # before it has joined
    world = server.worlds.worlds["arena-1"]
    assert world.free == 0
    second = server.peer(go.path)
    server.run(0.1)
    second.lose()  # after it has joined
    third = server.peer(go.path)
    server.run(0.1)
    assert second.welcome is not None
    assert third.welcome is not None
    assert third.welcome.entity == second.welcome.entity
    assert len(world.game.players) == 1
    third.lose()
    server.run(15.5)  # the player leaves
    assert not world.game.players
    fourth = server.peer(go.path)
    server.run(0.1)
    assert fourth.welcome is not None
    assert len(world.game.players) == 1


def test_bytes_in_the_lobby() -> None:
    server = Server(kind(players_max=1, worlds_max=1))
    server.play("/match?kind=arena")
    cases = [
        (b"", "not MessagePack (ValueError)"),
        (b"\x91\x01", "Hello: 0 fields instead of 5"),
        (messages.encode(messages.Inputs(0, 0, b"")), "unexpected Inputs in the lobby"),
        (messages.encode(messages.Hello(messages.VERSION, {}, "n")), "unexpected Hello in the lobby"),
    ]
    for data, reason in cases:
        peer = server.peer("/match?kind=arena")
        assert peer.over is None
        peer.way.receive(peer.session, data, server.now)
        assert peer.over is not None
        assert (peer.over[0], peer.over[1].startswith(reason[:20])) == (messages.MALFORMED, True), peer.over
    flood = server.peer("/match?kind=arena")
    for k in range(100):
        flood.send(messages.Ping(float(k)))
    assert flood.over == (messages.MALFORMED, "too many messages")
    silent = server.peer("/match?kind=arena")
    silent.lose()
    silent.session = silent.way.open(silent, server.now)
    server.run(5.5)
    assert silent.over == (messages.NO_HELLO, "no hello within 5 s")
    assert not server.worlds.lobby.sessions


def test_a_client_that_is_gone_waits_no_longer() -> None:
    server = Server(kind(players_max=1, worlds_max=1))
    first = server.play("/match?kind=arena")
    server.run(0.3)
    gone, slow = server.peer("/match?kind=arena"), server.peer("/match?kind=arena")
    gone.unread = 60
    for k in range(8):
        first.send(messages.Ping(float(k)))  # it goes on playing
        slow.unread = 60
        server.run(2)
        slow.unread = 0
        server.run(0.2)
    assert gone.over == (messages.TOO_SLOW, "nothing reached the client for 15 s")
    assert slow.over is None


def test_a_kept_world_comes_back_and_others_do_not() -> None:
    server = Server(kind("home", keep=True, empty_s=1), kind("arena", empty_s=1))
    server.worlds.create("home", {"owner": "ann"}, private=True, name="anns")
    code = server.worlds.get("anns").code
    server.worlds.create("arena")
    server.run(2)
    assert not server.worlds.worlds
    assert server.host.done[-2:] == [("kept", "anns"), ("ended", "arena-1")]
    back = server.play(f"/join?code={code}")
    server.run(0.5)
    assert back.welcome is not None
    world = server.worlds.get("anns")
    assert (world.code, world.properties) == (code, {"owner": "ann"})


def test_drain_and_shut_down() -> None:
    server = Server(kind())
    peer = server.play("/match?kind=arena")
    server.run(0.5)
    server.worlds.draining = True
    waiting = server.peer("/match?kind=arena&mode=x")
    created = server.peer("/create?kind=arena")
    assert created.over == (messages.NOT_ADMITTED, "the server is about to stop")
    server.worlds.shut_down("the server is going down", 2.0)
    assert peer.got[-1] == waiting.got[-1] == Bye(messages.GOING_AWAY, "the server is going down", 2.0)


def test_an_authenticator_that_is_wrong_is_reported_in_the_lobby_too() -> None:
    def wrong(token: str) -> Any:
        if token == "odd":
            return 7
        raise ZeroDivisionError

    server = Server(kind(), authenticate=wrong)
    odd, broken = (server.peer("/match?kind=arena", token=token) for token in ("odd", "broken"))
    assert odd.over == (messages.UNAUTHORISED, "the server's authenticator returned no valid subject")
    assert broken.over == (messages.INTERNAL, "internal error")
    assert server.worlds.faults.total == 2
