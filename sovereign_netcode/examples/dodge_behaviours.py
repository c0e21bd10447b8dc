"""The behaviours of dodge, which the server runs and every client predicts: dash, double jump, throws and hits.

A client imports them without the rules: `Client.connect(url, behaviours=BEHAVIOURS)`.
"""

import math

from sovereign_netcode.shared.behaviours import Behaviour, field
from sovereign_netcode.shared.body import Body


class Dodger(Behaviour):
    """A player: it dashes, jumps twice, throws balls, and is knocked back by those of the other team.

    Its template is "player", "dashing" for a moment after a dash, or "out" until the rules bring it back. Balls pass
    through a player who dashes.
    """

    templates = ("player", "dashing", "out")
    spawns = 8  # balls in the air at the same time
    always = True  # a ball also hits a player who stands still

    team = field(bits=1)
    health = field(bits=3, start=3)
    ready_at = field(bits=32)  # tick of the next dash
    loaded_at = field(bits=32)  # tick of the next throw
    until = field(bits=32)  # tick at which the dash, or the time out of play, ends
    jumped = field(bits=1)  # whether the second jump is used up
    hits = field(bits=16)  # number of hits that the player took
    hit_by = field(bits=32)  # the thrower of the latest one

    def turn(self, me: Body) -> None:
        if me.template == "out":
            return
        if me.template == "dashing" and me.tick >= me.until:
            me.become("player")
        if me.template == "player":
            self.take_hits(me)
        if me.template != "out":
            self.jump(me)
            self.dash(me)
            self.throw(me)

    def take_hits(self, me: Body) -> None:
        for ball in me.touching("ball"):
            if ball.team == me.team or not me.health:
                continue
            (x, y, _), (vx, vy, _) = me.velocity, ball.velocity
            me.velocity = (x + 0.7 * vx, y + 0.7 * vy, 5.0)
            me.health -= 1
            me.hits = (me.hits + 1) & 0xFFFF
            me.hit_by = ball.by
            me.announce("hit", {"by": ball.by, "left": me.health})
        if not me.health:
            me.until = me.tick + 96
            me.become("out")

    def jump(self, me: Body) -> None:
        if not me.falling:
            me.jumped = 0
        elif me.pressed("jump") and not me.jumped:
            x, y, _ = me.velocity
            me.velocity = (x, y, 7.5)
            me.jumped = 1
            me.announce("double jump")

    def dash(self, me: Body) -> None:
        if me.pressed("dash") and me.tick >= me.ready_at and me.move != (0, 0):
            me.ready_at = me.tick + 48
            me.until = me.tick + 6
            me.become("dashing")
            me.announce("dash")

    def throw(self, me: Body) -> None:
        """Throws a ball to where the player aims, else to where it walks."""
        if not me.held("fire") or me.tick < me.loaded_at:
            return
        east, north, up = me.aim or (*me.move, 0)
        length = math.sqrt(east * east + north * north + up * up)  # sqrt rounds alike on every machine; sin does not
        if not length:
            return
        way = (east / length, north / length, up / length)
        x, y, z = me.position
        start = (x + 0.6 * way[0], y + 0.6 * way[1], z + 1.1 + 0.6 * way[2])
        speed = (14 * way[0], 14 * way[1], 14 * way[2])
        if me.spawn("ball", start, speed, by=me.id, team=me.team, gone_at=me.tick + 64):
            me.loaded_at = me.tick + 16
            me.announce("throw")


class Ball(Behaviour):
    """A ball in the air. It disappears when it hits a player of the other team, or a wall, or after two seconds."""

    templates = ("ball",)
    always = True

    team = field(bits=1)
    by = field(bits=32)  # the thrower
    gone_at = field(bits=32)

    def turn(self, me: Body) -> None:
        x, y, _ = me.velocity
        stopped = x == 0 and y == 0
        if stopped or me.tick >= me.gone_at or any(other.team != me.team for other in me.touching("player")):
            me.remove()


BEHAVIOURS = (Dodger, Ball)
