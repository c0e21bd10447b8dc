"""The behaviour of cars in the race, which the server runs and every client predicts.

A client imports it without the rules: `Client.connect(url, behaviours=BEHAVIOURS)`.
"""

import math

from sovereign_netcode.shared.behaviours import Behaviour, field
from sovereign_netcode.shared.body import Body


class Car(Behaviour):
    """A car: it burns fuel while it boosts, and fills up where it drives over a pad.

    Its template is "boosting" while it boosts. How a car accelerates and drifts is a matter of its template alone.
    """

    templates = ("player", "boosting")

    fuel = field(bits=7, start=48)  # ticks of boost

    def turn(self, me: Body) -> None:
        x, y, z = (math.floor(part) for part in me.position)
        if me.fuel < 64 and me.block(x, y, z - 1) == me.kind("pad"):
            me.fuel = 96
            me.announce("refuel")
        boosts = me.held("boost") and me.fuel > 0
        if boosts:
            me.fuel -= 1
        if boosts != (me.template == "boosting"):
            me.become("boosting" if boosts else "player")
            me.announce("boost", boosts)


BEHAVIOURS = (Car,)
