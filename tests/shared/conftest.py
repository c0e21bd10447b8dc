"""Fixtures for tests of the physics."""

import pytest


@pytest.fixture(params=["mean", "semi"])
def integrator(request: pytest.FixtureRequest) -> str:
    """Name of the integrator. The test runs once with each."""
    return str(request.param)
