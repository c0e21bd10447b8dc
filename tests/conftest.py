"""Settings of property tests: the same examples in every run and on every machine, without a time limit.

A test that steps a world runs twice: with the compiled kernel of this machine, and with the same source as plain
Python.
"""

import signal

import pytest
from hypothesis import HealthCheck, settings

from shared import kernels
from tests.lengths import EXAMPLES

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
