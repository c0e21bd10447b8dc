"""Property tests are the same in every run and on every machine: the same examples, and no limit on time.

A test that steps a world runs it both ways: by the compiled kernel that runs here, and by the same source plain.
"""

import signal

import pytest
from hypothesis import HealthCheck, settings

from shared import kernels
from tests.lengths import EXAMPLES

SAME = settings(derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("short", SAME, max_examples=EXAMPLES // 5)
settings.register_profile("long", SAME, max_examples=EXAMPLES)
settings.load_profile("short")  # or the one that --hypothesis-profile names

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A script has started the tests in the background. What they start in turn shall be as on a terminal.
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
