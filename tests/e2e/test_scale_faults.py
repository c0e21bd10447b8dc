"""Faults of one world on real processes: no command is lost or doubled, and all parts have the same world."""

import pytest

from scripts.scale_lab import faults
from scripts.scale_lab.nats_server import binary

pytestmark = [pytest.mark.e2e, pytest.mark.skipif(not binary(), reason="there is no nats-server here")]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11])
async def test_disturbances_lose_nothing(seed: int) -> None:
    lines: list[str] = []
    lab = await faults.run(seed, players=3, disturbances=3, report=lines.append)
    assert lab.wrong == [], lines
    assert len(lab.disturbances) == 3
