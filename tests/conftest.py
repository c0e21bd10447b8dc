"""Settings of property tests: the same examples in every run and on every machine, without a time limit.

A test that steps a world runs twice: with the compiled kernel of this machine, and with the same source as plain
Python.
"""

import signal

import pytest
from hypothesis import HealthCheck, settings

from shared import kernels
from tests.lengths import EXAMPLES, sampled

SAME = settings(derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("short", SAME, max_examples=EXAMPLES // 5)
settings.register_profile("long", SAME, max_examples=EXAMPLES)
settings.load_profile("short")  # the option --hypothesis-profile selects another profile

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A script has started the tests in the background. Processes that they start must behave as on a terminal.
    signal.signal(signal.SIGINT, signal.default_int_handler)


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


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Makes long ones of most variants of a test that has many."""
    variants: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("slow") is None:
            variants.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for found in variants.values():
        kept = sampled(len(found))
        for place, item in enumerate(found):
            if place not in kept:
                item.add_marker("slow")
