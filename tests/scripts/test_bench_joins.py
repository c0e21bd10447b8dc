"""`bench.py joins`: clients join and play on."""

from scripts.benchmarks.joins import Joined
from shared.scene import load_scene


def test_those_who_joined_play_on() -> None:
    joined = Joined(load_scene("meadow"), 3)
    for turn in (1, 2):
        joined.join()
        joined.tick()
        joined.tick()
        assert len(joined.game.players) == len(joined.clients) == 3 * turn
        assert all(session.acknowledged and not session.closed for session in joined.clients)
