"""A match is a large knot of references in few objects: it is untied after each test, or memory grows by gigabytes."""

import gc
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def _untie() -> Iterator[None]:
    yield
    gc.collect()
