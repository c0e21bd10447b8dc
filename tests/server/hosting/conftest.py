"""Timers of the tickers that ring only when a test says so."""

import pytest

from tests.server.hosting.bench import Alarm, fake_alarms


@pytest.fixture
def alarms(monkeypatch: pytest.MonkeyPatch) -> list[Alarm]:
    """The timers that are set."""
    return fake_alarms(monkeypatch)
