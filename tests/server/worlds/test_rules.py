"""The rules' side of worlds: sending players away, locking, describing, ending, making worlds, forming groups."""

from collections.abc import Iterable, Sequence

import pytest

from server.game import Game
from server.players.player import Player
from server.rules import Rules, RulesError, Ticket
from server.worlds.hosted import LOCKED
from server.worlds.kinds import WorldsError
from shared import messages
from shared.messages import Bye, Go
from tests.server.worlds.hosts import FLAT, Peer, Server, kind


class Hall(Rules):
    """Players who are sent to an arena by command, with what they carry."""

    def on_command(self, player: Player, name: str, payload: object) -> bool | str | None:
        worlds = self.game.worlds
        match name:
            case "play":
                arena = worlds.create("arena", mode=payload)
                return self.game.send_away(player, arena, {"gold": 7, "from": worlds.name}, "to the arena")
            case "go":
                try:
                    return self.game.send_away(player, str(payload))
                except WorldsError as error:
                    return str(error)
        return False


class Arena(Rules):
    """Keeps what was handed over, and locks, describes or ends its world by command."""

    def on_join(self, player: Player) -> None:
        self.game.set(player.entity, "handed", player.handed)

    def on_command(self, player: Player, name: str, payload: object) -> bool | str | None:
        worlds = self.game.worlds
        match name:
            case "lock":
                worlds.lock()
            case "open":
                worlds.unlock()
            case "describe":
                worlds.describe(map="desert", mode=None)
            case "end":
                worlds.end("red wins")
        return True


def commands(peer: Peer, number: int, name: str, data: bytes = b"\xc0") -> None:
    """Sends a command of a client."""
    peer.send(messages.Command(number, 0, 0.0, name, data))


def verdicts(peer: Peer) -> list[str]:
    """Returns the reasons of refused commands."""
    return [message.reason for message in peer.got if isinstance(message, messages.Refusal)]


def test_a_player_is_sent_away_with_what_it_carries() -> None:
    server = Server(kind("hall", Hall), kind("arena", Arena))
    peer = server.play("/match?kind=hall")
    server.run(0.5)
    hall = server.worlds.get("hall-1")
    commands(peer, 0, "play", b"\xa2ab")
    server.run(0.2)
    assert peer.over == (1000, "")
    assert peer.go.reason == "to the arena"
    assert not hall.game.players
    arrived = server.peer(peer.go.path)
    server.run(0.3)
    arena = server.worlds.get("arena-1")
    (player,) = arena.game.players.values()
    assert arrived.welcome is not None
    assert player.handed == {"gold": 7, "from": "hall-1"}
    assert arena.properties == {"mode": "ab"}
    assert arena.game.api.get(player.entity, "handed") == {"gold": 7, "from": "hall-1"}


def test_a_player_stays_where_the_other_world_has_no_room_or_is_not_there() -> None:
    server = Server(kind("hall", Hall), kind("arena", Arena, players_max=1))
    server.play("/match?kind=arena")
    peer = server.play("/match?kind=hall")
    server.run(0.5)
    commands(peer, 0, "go", b"\xa7arena-1")
    commands(peer, 1, "go", b"\xa4gone")
    server.run(0.3)
    assert verdicts(peer) == ["the world 'arena-1' is full (1 players)", "there is no world 'gone'"]
    assert peer.over is None


def test_lock_describe_and_end() -> None:
    server = Server(kind("arena", Arena))
    peer = server.play("/match?kind=arena&mode=x")
    server.run(0.5)
    commands(peer, 0, "lock")
    commands(peer, 1, "describe")
    server.run(0.2)
    late = server.peer("/arena-1")
    server.run(0.2)
    assert late.over == (messages.NOT_ADMITTED, LOCKED)
    assert server.worlds.entries()[0]["properties"] == {"map": "desert"}
    assert server.play("/match?kind=arena").path.startswith("/arena-2?")
    commands(peer, 2, "open")
    server.run(0.2)
    friend = server.peer("/arena-1")
    server.run(0.2)
    assert friend.welcome is not None
    commands(peer, 3, "end")
    server.run(0.3)
    for each in (peer, friend):
        assert each.over == (messages.ENDED, "red wins")
        assert each.got[-1] == Bye(messages.ENDED, "red wins", -1.0)
    assert "arena-1" not in server.worlds.worlds


def test_a_game_without_worlds_says_so() -> None:
    game = Game(FLAT, rules=Hall(), compiled=False)
    with pytest.raises(RulesError, match="this game runs alone"):
        _ = game.api.worlds


def test_the_default_world_is_nobody_s_to_end() -> None:
    server = Server(kind("arena"), default=(default := Game(FLAT, compiled=False)))
    assert server.worlds.route("/") is default
    worlds = default.api.worlds
    assert (worlds.name, worlds.kind, worlds.code, worlds.properties) == ("", "", "", {})
    with pytest.raises(WorldsError, match="end: the default world cannot do that"):
        worlds.end()


def test_a_player_is_sent_to_the_default_world() -> None:
    server = Server(kind("hall", Hall), default=(default := Game(FLAT, compiled=False)))
    peer = server.play("/match?kind=hall")
    server.run(0.3)
    commands(peer, 0, "go", b"\xa0")
    server.run(0.2)
    assert peer.go.path.startswith("/?seat=")
    arrived = server.peer(peer.go.path)
    default.tick(server.now, server.now)
    assert arrived.welcome is not None
    assert server.peer(peer.go.path).refused == "the seat is in use"


class Duel(Rules):
    """Two players of about the same rating; those who wait longer take a larger difference."""

    async def load_player(self, name: str, subject: str) -> int:
        if name == "cheat":
            raise ValueError("banned until Monday")
        return int(name)

    @staticmethod
    def pair(waiting: list[Ticket]) -> Iterable[Sequence[Ticket]]:
        waiting.sort(key=lambda ticket: int(ticket.loaded))
        groups, k = [], 0
        while k + 1 < len(waiting):
            a, b = waiting[k], waiting[k + 1]
            if b.loaded - a.loaded <= 50 + 10 * min(a.waited_s, b.waited_s):
                groups.append((a, b))
                k += 1
            k += 1
        return groups


def test_a_queue_with_a_rule_of_its_own() -> None:
    server = Server(kind("duel", Duel, players_max=2))
    a, b, c = (server.peer("/match?kind=duel", name=rating) for rating in ("1000", "1500", "1040"))
    server.run(0.5)
    assert a.go.path.partition("?")[0] == c.go.path.partition("?")[0] == "/duel-1"
    assert not any(isinstance(message, Go) for message in b.got)
    server.run(5)
    d = server.peer("/match?kind=duel", name="1600")
    server.run(8)
    assert b.go.path.partition("?")[0] == d.go.path.partition("?")[0] == "/duel-2"
    told = [message for message in b.got if isinstance(message, messages.Waiting)]
    assert len(told) >= 5
    cheat = server.peer("/match?kind=duel", name="cheat")
    assert cheat.over == (messages.NOT_ADMITTED, "banned until Monday")


class Broken(Rules):
    """A queue whose rule does what it must not."""

    result: object = None

    @staticmethod
    def pair(waiting: list[Ticket]) -> Iterable[Sequence[Ticket]]:
        match Broken.result:
            case "raise":
                raise ZeroDivisionError
            case "twice":
                return [[waiting[0]], [waiting[0]]]
            case "all":
                return [waiting] if len(waiting) == 3 else []
            case "foreign":
                return [[Ticket("x", "", {}, 1, 0.0)]]
            case "empty":
                return [[]]
        return Broken.result  # type: ignore[return-value]


@pytest.mark.parametrize("result", ["raise", "twice", "all", "foreign", "empty", None, 7, "text"])
def test_a_rule_that_fails_leaves_all_waiting(result: object) -> None:
    Broken.result = result
    server = Server(kind("duel", Broken, players_max=2))
    peers = [server.peer("/match?kind=duel", name="a") for _ in range(3)]
    server.run(1.5)
    assert server.worlds.matchmaking.waiting == 3
    assert server.worlds.faults.total > 0
    assert not server.worlds.worlds
    assert not any(peer.over for peer in peers)
    Broken.result = ()
    peers[0].lose()
    server.run(1.5)
    assert server.worlds.matchmaking.waiting == 2
