"""The input delay may change in the middle of play. The own figure goes on, and is never drawn further back."""

import dataclasses
from itertools import pairwise, product

import pytest

from shared.inputs import Input
from shared.scene import load_scene
from sovereign_netcode.playtest import Link, Match
from tests.lengths import long_but

CHANGES = ((3, 0, 2, 1, 3, 0), (1, 2, 3, 2, 1, 0), (3, 3, 0, 0, 3, 1))


LINKS = ((32, 0.02), (20, 0.0), (60, 0.1), (128, 0.02))
"""Tick rates, and the one-way delay of the link for each."""


@pytest.mark.parametrize(
    ("link", "changes", "every_s"),
    long_but(
        [(LINKS[0], CHANGES[0], 1.0), (LINKS[1], CHANGES[1], 0.03), (LINKS[2], CHANGES[2], 0.03)],
        product(LINKS, CHANGES, [1.0, 0.03]),
    ),
)
def test_a_figure_that_walks_east_is_never_drawn_further_west(
    link: tuple[int, float], changes: tuple[int, ...], every_s: float
) -> None:
    rate, delay_s = link
    match = Match(dataclasses.replace(load_scene("flat"), tick_rate=rate), 1)
    ann = match.join(lambda core, rng: Input(127, 0, 0), Link(delay_s))
    match.run_until(lambda: ann.core.state == "playing", 20)
    match.run(2)
    drawn = []
    for ticks in changes:
        ann.core.set_input_delay(ticks)
        for _ in range(round(240 * every_s)):
            match.run(1 / 240)
            me = ann.core.view(ann.local).me
            assert me is not None
            drawn.append(me.position[0])
    steps = [after - before for before, after in pairwise(drawn)]
    assert min(steps) >= 0
    # The figure moves by at most the difference of the delays and the time of a frame.
    assert max(steps) <= 3.0 * (3 + 1) / rate + 3.0 / 240
    match.run(1)
    ann.core.view(ann.local)
    assert ann.core.stats.corrections == 0
