"""Scripts must reach exactly these hashes at these ticks: compiled and plain, on every Python version and machine.

The hashes change only on purpose, by `scripts/regenerate_goldens.py`.
"""

import json
from pathlib import Path

import pytest

from tests.golden.scripts import MARKS, SCRIPTS, run

GOLDENS = json.loads((Path(__file__).parent.parent / "golden" / "physics.json").read_text("utf-8"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_first_hundred_ticks(compiled: bool, name: str) -> None:
    for tick, digest in run(name, compiled=compiled, ticks=100):
        assert digest == GOLDENS[name][str(tick)], f"{name} at tick {tick}"


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_two_thousand_ticks(compiled: bool, name: str) -> None:
    hashes = dict(run(name, compiled=compiled))
    assert {str(tick): digest for tick, digest in hashes.items()} == GOLDENS[name]
    assert tuple(hashes) == MARKS


def test_every_script_has_its_own_hashes() -> None:
    assert GOLDENS.keys() == SCRIPTS.keys()
    digests = [digest for marks in GOLDENS.values() for digest in marks.values()]
    assert len(set(digests)) == len(digests) == len(SCRIPTS) * len(MARKS)
