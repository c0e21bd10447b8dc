"""Starts a new game: writes NAME.py (its rules) and test_NAME.py (bots play it) to the current folder."""

import argparse
import importlib.util
import keyword
import shutil
import sys
from pathlib import Path

RULES = '''\
"""{title}: a game for Sovereign Netcode.

    sovereign-server --game {name}:{title}

`sovereign_netcode.server.rules` describes all hooks, `sovereign_netcode.server.game_api.api` what the hooks can do with
the game (`self.game`), and `sovereign_netcode.shared.behaviours` what behaviours are.
"""

from typing import Any

from sovereign_netcode.server import Player, Rules
from sovereign_netcode.shared.behaviours import Behaviour, field
from sovereign_netcode.shared.body import Body
from sovereign_netcode.shared.scene import Scene


class Dash(Behaviour):
    """A dash. The server and every client run this code alike, so a player sees its dash in the next frame.

    A client passes the class: `Client.connect(url, behaviours=[Dash])`. A browser gets it from the server.
    """

    templates = ("player", "runner")

    ready_at = field(bits=32)  # the tick of the next dash: a whole number that each player has, part of the exact state

    def turn(self, me: Body) -> None:
        # Called once per tick. A turn may read and change only what `me` offers, so that both sides get the same.
        if me.pressed("dash") and me.tick >= me.ready_at:
            east, north = me.move  # -127 to 127
            me.velocity = (east / 8, north / 8, 4.0)
            me.ready_at = me.tick + 32
            me.announce("dash")  # the own client gets it at once, as `Announced`


class {title}(Rules):
    """Two players who touch each other get a point each. A player with ten points is fast from then on."""

    scene = "meadow"
    behaviours = (Dash,)
    keys = {{"dash": "left shift"}}  # noqa: RUF012 - keys in the window of `sovereign-play` and in the browser

    def prepare(self, scene: Scene) -> Scene:
        # Friction makes the speed of a dash decay; without it a player would walk on in the next tick.
        scene = scene.with_buttons("dash").with_changes("player", friction=20.0)
        # Adds a template that equals the players' one except for the fields given here. Clients predict it exactly.
        return scene.with_template("runner", walk_speed=7.0)

    def on_start(self) -> None:
        # All clients receive shared values, as `client.shared`.
        self.game.share("points_to_win", 10)

    def on_join(self, player: Player) -> None:
        # All clients that see an entity receive its attributes, as `EntityView.attributes`. "name" is set already.
        self.game.set(player.entity, "points", 0)

    def on_contact(self, a: int, b: int) -> None:
        for entity in (a, b):
            points = self.game.get(entity, "points", 0) + 1
            self.game.set(entity, "points", points)
            if points == self.game.shared["points_to_win"]:
                self.game.change(entity, "runner")
                # All clients receive this event as `Happened`.
                self.game.send("winner", {{"entity": entity}})

    def on_command(self, player: Player, name: str, payload: Any) -> bool | None:
        # A client calls `client.command("home")`. Returning False rejects the command. What a player does all the time
        # is better a button and a behaviour: a command waits for the server.
        if name != "home":
            return False
        self.game.place(player.entity, self.game.scene.spawns[0])
        return True

    # def on_tick(self) -> None:
    #     if self.game.tick % self.game.ticks(5.0) == 0:  # every five seconds
    #         place = self.game.random.choice(self.game.scene.spawns)
    #         self.game.steer(self.game.spawn("runner", place, name="Dash"), 1, 0)  # walks east

    # def on_leave(self, player: Player) -> None:
    # def on_fell_out(self, entity: int) -> bool | None:
    # def can_edit(self, player: Player, x: int, y: int, z: int, kind: int) -> bool:
'''

TEST = '''\
"""{title}, played by bots in simulated time: `python -m pytest test_{name}.py`."""

from {name} import {title}
from sovereign_netcode.client_sdk.events import Announced, Happened
from sovereign_netcode.playtest import Link, Match, bot, check_behaviours
from sovereign_netcode.shared.inputs import NEUTRAL, Input, make_input
from sovereign_netcode.shared.scene import load_scene
from sovereign_netcode.shared.world import World


def seek(world: World, me: int) -> Input:
    """A bot that hops to the first other entity. It is called once per tick, with its client's predicted world."""
    others = [entity for entity in world.entities["id"].tolist() if entity != me]
    if not others:
        return NEUTRAL
    (x, y, _), (to_x, to_y, _) = world.position(me), world.position(others[0])
    return make_input(to_x - x, to_y - y, jump=True)


def test_two_bots_play() -> None:
    match = Match(load_scene({title}.scene), seed=1, rules={title}())
    ann, bob = match.join(bot(seek), Link(0.05)), match.join(bot(seek), Link(0.05))  # 50 ms each way
    match.run(20)

    game = match.game.api  # the object that the rules have as `self.game`
    assert game.get(ann.core.entity, "points") == game.get(bob.core.entity, "points") > 0
    for player in (ann, bob):
        assert player.core.state == "playing"
        assert player.core.stats.divergences == 0
    assert match.game.counters.rules_failed == 0


def test_ten_points_make_fast_and_are_announced() -> None:
    match = Match(load_scene({title}.scene), seed=1, rules={title}())
    ann = match.join(bot(seek))
    match.run(2)
    game, entity = match.game.api, ann.core.entity
    game.set(entity, "points", 9)
    x, y, z = game.position(entity)
    other = game.spawn("player", (x + 2, y, z))  # Ann hops to it
    match.run_until(lambda: other in game.touching(entity), 10)
    match.run(1)
    assert game.template(entity) == "runner"
    assert [event.data for event in ann.events if isinstance(event, Happened)] == [{{"entity": entity}}]


def test_turns_compute_the_same_everywhere() -> None:
    check_behaviours({title}(), ticks=100, players=2, processes=1)  # finds turns that read a clock, for example


def test_a_dash_is_predicted() -> None:
    match = Match(load_scene({title}.scene), seed=1, rules={title}())
    ann = match.join(lambda core, random: core.input, Link(0.15))  # 300 ms for a round trip
    match.run(3)
    x = match.game.api.position(ann.core.entity)[0]
    ann.core.set_input(make_input(1, 0), {{"dash": True}})
    match.run(0.05)
    assert [event.name for event in ann.events if isinstance(event, Announced)] == ["dash"]
    assert match.game.api.position(ann.core.entity)[0] == x  # the server does not know it yet
    match.run(1)
    assert match.game.api.position(ann.core.entity)[0] > x + 5
    assert ann.core.stats.corrections == 0  # both have computed the same
'''


def main() -> int:
    """Writes the two files and prints how to use them. Returns the exit code."""
    parser = argparse.ArgumentParser(prog="sovereign-new-game", description=__doc__)
    parser.add_argument(
        "name", metavar="NAME", help="the game's name: lower-case letters, digits and _, like king_of_the_hill"
    )
    name = parser.parse_args().name
    title = "".join(part.capitalize() for part in name.split("_"))
    if not name.isidentifier() or name != name.lower() or keyword.iskeyword(name):
        return failed(f"NAME = {name!r}: must be lower-case letters, digits and _, like king_of_the_hill")
    files = {Path(f"{name}.py"): RULES, Path(f"test_{name}.py"): TEST}
    for path in files:
        if path.exists():
            return failed(f"{path} exists already and was not changed")
    if importlib.util.find_spec(name) is not None:
        return failed(f"NAME = {name!r}: a module of that name exists already")
    for path, text in files.items():
        path.write_text(text.format(name=name, title=title), encoding="utf-8")
    print(f"Wrote {' and '.join(map(str, files))}. Now try:")
    if importlib.util.find_spec("pytest") is None:
        print(f"  {sys.executable} -m pip install pytest")
    print(f"  {sys.executable} -m pytest test_{name}.py")
    print(f"  {command('play')} --game {name}:{title}")
    print(f"  {command('play')} --game {name}:{title} --browser")
    print(f"  {command('play')} --game {name}:{title} --picture {name}.png")
    print(f"  {command('server')} --game {name}:{title}")
    return 0


def command(name: str) -> str:
    """Returns the command line of an installed command: its name alone if PATH leads to this environment."""
    found = shutil.which(f"sovereign-{name}")
    if found is not None and Path(found).parent == Path(sys.executable).parent:
        return f"sovereign-{name}"
    return f"{sys.executable} -m sovereign_netcode.{name}"


def failed(why: str) -> int:
    """Prints an error. Returns the exit code."""
    print(f"error: {why}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
