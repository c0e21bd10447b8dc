"""Worlds: made, found, full, locked, private, empty and ended."""

from server.config.limits import Limits
from server.worlds.hosted import FULL, LOCKED, PRIVATE
from shared import messages
from tests.server.worlds.hosts import Server, kind


def test_a_match_makes_a_world_and_the_next_clients_fill_it() -> None:
    server = Server(kind(players_max=2))
    first = server.play("/match?kind=arena&mode=2v2")
    second = server.play("/match?mode=2v2&kind=arena")
    third = server.play("/match?kind=arena&mode=2v2")
    other = server.play("/match?kind=arena&mode=ffa")
    server.run(0.5)
    assert all(peer.welcome is not None for peer in (first, second, third, other))
    assert [path.path.partition("?")[0] for path in (first, second, third, other)] == [
        "/arena-1",
        "/arena-1",
        "/arena-2",
        "/arena-3",
    ]
    entries = server.worlds.entries()
    assert [(entry["name"], entry["players"], entry["full"], entry["properties"]) for entry in entries] == [
        ("arena-1", 2, True, {"mode": "2v2"}),
        ("arena-2", 1, False, {"mode": "2v2"}),
        ("arena-3", 1, False, {"mode": "ffa"}),
    ]


def test_a_world_rests_when_empty_and_ends_later() -> None:
    server = Server(kind(empty_s=5))
    peer = server.play("/match?kind=arena")
    server.run(0.5)
    peer.send(messages.Bye(1000, "", -1.0))
    server.run(1)
    assert server.host.done == [("begin", "arena-1"), ("wake", "arena-1"), ("rest", "arena-1")]
    server.run(3)
    assert "arena-1" in server.worlds.worlds
    server.run(2)
    assert server.host.done[-1] == ("ended", "arena-1")
    assert not server.worlds.worlds
    assert server.peer("/arena-1").refused == "there is no world 'arena-1'"


def test_doors_full_locked_and_private() -> None:
    server = Server(kind(players_max=2))
    public = server.worlds.create("arena")
    private = server.worlds.create("arena", private=True)
    for peer, reason in (
        (server.peer(f"/{private.name}"), PRIVATE),
        (server.peer(f"/join?code={private.code}"), ""),
    ):
        server.run(0.2)
        if reason:
            assert peer.over == (messages.NOT_ADMITTED, reason)
        else:
            assert peer.go.path.startswith(f"/{private.name}?seat=")
            assert peer.go.code == private.code
    a, b, c = (server.peer(f"/{public.name}") for _ in range(3))
    server.run(0.2)
    assert (a.welcome is not None, b.welcome is not None, c.over) == (True, True, (messages.FULL, FULL))
    b.send(messages.Bye(1000, "", -1.0))
    server.run(0.2)
    public.locked = True
    d = server.peer(f"/{public.name}")
    server.run(0.2)
    assert d.over == (messages.NOT_ADMITTED, LOCKED)


def test_friends_land_together_and_a_seat_counts_once() -> None:
    server = Server(kind(players_max=3))
    first = server.peer("/match?kind=arena&seats=3")
    paths = [first.go.path, *first.go.seats]
    assert len(set(paths)) == 3
    assert server.worlds.entries()[0]["full"]
    peers = [server.peer(path) for path in paths]
    again = server.peer(paths[0])
    server.run(0.5)
    assert all(peer.welcome is not None for peer in peers)
    assert again.refused == "the seat is in use"


def test_a_seat_is_given_back_when_nobody_takes_it() -> None:
    server = Server(kind(players_max=1), limits=Limits(seat_s=3.0))
    go = server.peer("/match?kind=arena").go
    assert server.worlds.worlds["arena-1"].free == 0
    server.run(3.2)
    assert server.worlds.worlds["arena-1"].free == 1
    assert server.peer(go.path).refused == "the seat has expired; ask for a match again"


def test_who_finds_no_world_waits_for_one() -> None:
    server = Server(kind(players_max=1, worlds_max=1, empty_s=1))
    first = server.play("/match?kind=arena")
    server.run(0.5)
    second = server.peer("/match?kind=arena")
    server.run(3)
    waiting = [message for message in second.got if isinstance(message, messages.Waiting)]
    assert waiting
    assert second.over is None
    first.send(messages.Bye(1000, "", -1.0))
    server.run(2)
    assert second.go.path.startswith("/arena-1?seat=")
