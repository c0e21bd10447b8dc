"""Every test that steps a world runs it both ways: compiled by Numba, and the same source plain."""

import pytest

from shared import kernels


@pytest.fixture(
    params=[
        pytest.param(True, marks=pytest.mark.skipif(not kernels.available(), reason="Numba is not installed")),
        False,
    ],
    ids=["compiled", "plain"],
)
def compiled(request: pytest.FixtureRequest) -> bool:
    """Whether the world of this test runs the compiled kernel."""
    return bool(request.param)


@pytest.fixture(params=["mean", "semi"])
def integrator(request: pytest.FixtureRequest) -> str:
    """Each of the two integrators."""
    return str(request.param)
