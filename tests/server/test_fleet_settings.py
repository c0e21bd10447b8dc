"""Tests of the settings of a fleet."""

from pathlib import Path

import pytest

from server.config.options import SettingsError
from server.config.settings import load

BUS = "nats://127.0.0.1:4222"


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "server.toml"
    path.write_text("[worlds.arena]\nplayers_max = 4\n", "utf-8")
    return str(path)


def test_a_fleet_needs_a_name_a_bus_and_kinds(config: str) -> None:
    settings = load({"fleet": "eu", "bus": BUS, "public_url": "ws://a.example"}, {}, config)
    assert (settings.fleet, settings.bus, settings.role) == ("eu", BUS, "server")


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        ({"fleet": "eu"}, "fleet = 'eu' (from --fleet): needs bus as well"),
        ({"fleet": "e.u", "bus": BUS}, "fleet = 'e.u' (from --fleet): must be 1 to 32 letters, digits, - and _"),
        ({"fleet": "eu", "bus": BUS, "role": "edge"}, "fleet (from --fleet): is for role server only"),
        ({"bus": BUS}, "bus (from --bus): needs role or fleet as well"),
        ({"fleet": "eu", "bus": BUS, "reload": "true", "game": "a:B"}, "fleet = 'eu' (from --fleet): excludes reload"),
    ],
)
def test_combinations_that_cannot_be_used_are_named(config: str, flags: dict[str, str], reason: str) -> None:
    with pytest.raises(SettingsError) as error:
        load(flags, {}, config)
    assert str(error.value) == reason


def test_a_fleet_without_kinds_and_with_a_long_name_of_one(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="needs kinds of worlds"):
        load({"fleet": "eu", "bus": BUS}, {})
    path = tmp_path / "server.toml"
    path.write_text(f"[worlds.{'a' * 25}]\n", "utf-8")
    with pytest.raises(SettingsError, match="at most 24 characters"):
        load({"fleet": "eu", "bus": BUS}, {}, str(path))
