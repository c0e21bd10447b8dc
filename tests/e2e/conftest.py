"""Fixtures of the tests in browsers."""

import pytest

from scripts.browser_build import runtime
from scripts.browser_build.packages import FetchError, npm_package, wheels


@pytest.fixture(scope="session")
def python_for_browsers() -> None:
    """Makes Python for browsers, if it is not there yet. Without a registry, the test is skipped."""
    try:
        if not runtime.ready():
            runtime.make(npm_package("pyodide"), wheels())
    except FetchError as error:
        pytest.skip(str(error))
