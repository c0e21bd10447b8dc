"""What tests of the physics run under."""

import pytest


@pytest.fixture(params=["mean", "semi"])
def integrator(request: pytest.FixtureRequest) -> str:
    """Each of the two integrators."""
    return str(request.param)
