from sovereign_netcode.server import Player, Rules
from sovereign_netcode.shared.scene import Scene


class Freeze(Rules):
    """The first player freezes the others by touching them; players who are free thaw the frozen ones."""

    scene = "meadow"

    def prepare(self, scene: Scene) -> Scene:
        return scene.with_template("freezer", walk_speed=6).with_template("frozen", walk_speed=0, jump_speed=0)

    def on_join(self, player: Player) -> None:
        if not self.game.entities("freezer"):
            self.game.change(player.entity, "freezer")

    def on_contact(self, a: int, b: int) -> None:
        for one, other in ((a, b), (b, a)):
            match self.game.template(one), self.game.template(other):
                case "freezer", "player":
                    self.game.change(other, "frozen")
                    self.game.throw(other, (0, 0, 0))  # what does not walk keeps its velocity
                case "player", "frozen":
                    self.game.change(other, "player")
