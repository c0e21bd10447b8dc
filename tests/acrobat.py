"""Behaviours that use every ability of `shared.body`; without the server, so that they run in a browser, too."""

from shared.behaviours import Behaviour, field
from shared.body import Body

HIGH, LOW = (1 << 47) - 1, -(1 << 47)


class Acrobat(Behaviour):
    """Dashes, shoots, builds, grows, is stunned, and writes fields of every size up to their limits."""

    templates = ("player", "dashing", "tall")
    spawns = 3
    stamina = field(bits=8, start=200)
    ready_at = field(bits=32)
    until = field(bits=32)
    stunned_to = field(bits=32)
    flag = field(bits=1)
    tilt = field(bits=7, start=-64, signed=True)
    luck = field(bits=20, signed=True)
    most = field(bits=48, start=(1 << 48) - 1)
    least = field(bits=48, start=LOW, signed=True)
    shots = field(bits=16)
    last = field(bits=31)

    def turn(self, me: Body) -> None:
        if me.tick < me.stunned_to:
            me.steer(0.25, 0.0)
            me.wake(me.stunned_to)
            return
        if me.pressed("dash") and me.tick >= me.ready_at and me.stamina >= 10:
            self.dash(me)
        if me.pressed("fire"):
            self.fire(me)
        if me.pressed("build"):
            self.build(me)
        if me.pressed("recall") and any(seen.entity == me.last for seen in me.near(64.0, "shot")):
            me.remove(me.last)
            me.announce("recall")
        if me.held("grow") and me.template == "player":
            if not me.become("tall"):
                me.announce("bump")
        elif me.template != "player" and me.tick >= me.until and not me.held("grow") and me.become("player"):
            me.luck = me.chance(1 << 20) - (1 << 19)
        if me.released("jump"):
            me.flag ^= 1
            me.most, me.least = me.least + (1 << 47), me.most - (1 << 47)
            me.tilt = min(me.tilt + me.chance(9), 63) if me.tilt < 60 else -64
        if me.stamina < 200 and me.tick % 32 == 0:
            me.stamina += 5

    def dash(self, me: Body) -> None:
        me.stamina -= 10
        me.ready_at, me.until = me.tick + 8, me.tick + 5
        me.wake(me.until)
        if me.become("dashing"):
            x, y = me.move
            me.velocity = (x / 16, y / 16, 2.0)
            me.announce("dash", {"left": me.stamina})
        for other in me.touching("player") + me.near(1.5, "dashing"):
            me.luck = other.stamina - other.entity
        if me.chance(6) == 0:
            me.stunned_to = me.tick + 6

    def fire(self, me: Body) -> None:
        x, y, z = me.position
        aim = me.aim or (1.0, 0.0, 0.0)
        speed = (12.0 * aim[0], 12.0 * aim[1], 6.0 * aim[2] + me.chance(3))
        made = me.spawn("shot", (x, y, z + 1.0), speed, dies_at=me.tick + 20 + me.chance(20))
        if made is not None:
            me.shots = (me.shots + 1) & 0xFFFF
            me.last = made
            me.announce("shot", made)
        else:
            me.announce("click")

    def build(self, me: Body) -> None:
        x, y, z = (int(part // 1) for part in me.position)
        at = x + me.chance(5) - 2, y + me.chance(5) - 2, z + me.chance(3)
        if me.edit(*at, 0 if me.block(*at) else 4):
            me.announce("built", list(at))


class Shot(Behaviour):
    """Flies, hits players and crates, and dies."""

    templates = ("shot",)
    dies_at = field(bits=32)
    bounces = field(bits=3, signed=True)

    def turn(self, me: Body) -> None:
        if me.tick >= me.dies_at:
            me.remove()
            return
        if any(not me.owns(seen.entity) for seen in me.touching("crate")):
            me.announce("hit", me.id)
            me.remove()
        elif me.velocity == (0.0, 0.0, 0.0) and me.bounces < 3:
            me.bounces += 1
            me.velocity = (0.0, 0.0, 5.0)
        me.wake(me.dies_at)


class Crate(Behaviour):
    """Changes its size by itself; no player is near or far."""

    templates = ("crate", "barrel")
    turns = field(bits=40, start=7)

    def turn(self, me: Body) -> None:
        me.turns = (me.turns + 1) & 0xFFFFFFFF
        if me.turns % 2:
            me.become("barrel" if me.template == "crate" else "crate")
        me.wake(me.tick + 5 + me.chance(20))


CLASSES: tuple[type[Behaviour], ...] = (Acrobat, Shot, Crate)
