"""Settings of property tests: the same examples in every run and on every machine, without a time limit.

A test that steps a world runs twice: with the compiled kernel of this machine, and with the same source as plain
Python. All worlds of a process share the terrain that is generated for them.
"""

import os
import signal
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from server.runtime.event_loop import freeze
from shared import kernels, terrain
from shared.blocks import Kinds
from shared.checks import Cell
from tests.lengths import EXAMPLES, sampled, spread

SAME = settings(derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("short", SAME, max_examples=EXAMPLES // 5)
settings.register_profile("long", SAME, max_examples=EXAMPLES)
settings.load_profile("short")  # the option --hypothesis-profile selects another profile

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A script has started the tests in the background. Processes that they start must behave as on a terminal.
    signal.signal(signal.SIGINT, signal.default_int_handler)


SEGMENTS_KEPT = 1024
"""Segments of terrain that a process keeps: 32 MB, or the scene `hills` four times."""


@pytest.fixture(scope="session", autouse=True)
def _terrain_once() -> Iterator[None]:
    """Lets worlds share generated segments. The scene `hills` takes 0.2 s otherwise, and hundreds of tests play it."""
    made: dict[tuple[str, Cell], Kinds] = {}
    generate = terrain.generate

    def kept(table: Mapping[str, Any], segment: Cell) -> Kinds:
        key = repr(table), segment
        if key not in made:
            if len(made) == SEGMENTS_KEPT:
                made.clear()
            made[key] = generate(table, segment)
            made[key].flags.writeable = False
        return made[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(terrain, "generate", kept)
        yield


@pytest.fixture(
    params=[
        pytest.param(True, marks=pytest.mark.skipif(not kernels.available(), reason="there is no compiled kernel")),
        False,
    ],
    ids=["compiled", "plain"],
)
def compiled(request: pytest.FixtureRequest) -> bool:
    """Whether the world of this test runs the compiled kernel."""
    return bool(request.param)


def pytest_collection_finish() -> None:
    """Excludes the tests and all modules from garbage collection, which takes 2 to 4 % of the time otherwise."""
    freeze()


@pytest.hookimpl(tryfirst=True, wrapper=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Iterator[None]:
    """Makes long ones of most variants of a test that has many. Lets the workers begin with the longest tests."""
    variants: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("slow") is None:
            variants.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for found in variants.values():
        kept = sampled(len(found))
        for place, item in enumerate(found):
            if place not in kept:
                item.add_marker("slow")
    yield  # other hooks deselect tests here
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        longest = [item for item in items if item.get_closest_marker("longest") is not None]
        items[:] = spread(longest, [item for item in items if item not in longest], workers)
