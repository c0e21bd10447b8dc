"""The game in the README, played as a reader of the README would write it."""

from sovereign_netcode.client_sdk.bots import Policy
from sovereign_netcode.examples.freeze import Freeze
from sovereign_netcode.playtest import Link as Line
from sovereign_netcode.playtest import Match, Player, bot
from sovereign_netcode.shared.inputs import NEUTRAL, Input, make_input
from sovereign_netcode.shared.scene import load_scene
from sovereign_netcode.shared.world import World

TYPICAL = Line(0.05, 0.01)


def to(number: int) -> Policy:
    """Returns a bot that hops to the player who joined as the `number`th."""

    def policy(world: World, me: int) -> Input:
        everybody = world.entities["id"].tolist()
        if len(everybody) < number or everybody[number - 1] == me:
            return NEUTRAL
        (x, y, _), (to_x, to_y, _) = world.position(me), world.position(everybody[number - 1])
        return make_input(to_x - x, to_y - y, jump=True)

    return policy


def heading(x: int, y: int) -> Policy:
    """Returns a bot that hops into one direction."""
    return lambda world, me: make_input(x, y, jump=True)


def clean(player: Player) -> None:
    assert player.core.stats.divergences == 0
    assert set(player.core.stats.corrections_by_cause) <= {"server act", "other entity", "late input"}


def test_a_touched_player_freezes_and_is_thawed_by_a_friend() -> None:
    match = Match(load_scene(Freeze.scene), seed=3, rules=Freeze())
    ann, bob = match.join(bot(to(2)), TYPICAL), match.join(bot(heading(-1, 0)), TYPICAL)
    match.run(1)
    game = match.game.api
    assert game.template(ann.core.entity) == "freezer"
    match.run_until(lambda: game.template(bob.core.entity) == "frozen", 20)
    match.run(2)
    place = game.position(bob.core.entity)
    match.run(2)
    assert game.position(bob.core.entity) == place
    assert bob.core.input.move_x == -127, "the player wants to walk, but is frozen"

    ann.policy = bot(heading(-1, 0))
    match.run(3)
    cleo = match.join(bot(to(2)), TYPICAL)
    match.run_until(lambda: cleo.core.entity > 0 and game.template(bob.core.entity) == "player", 20)
    for player in (ann, bob, cleo):
        clean(player)
    assert match.game.counters.rules_failed == 0
