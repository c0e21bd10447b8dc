"""The settings of the kinds of worlds: tables of the file."""

from pathlib import Path

import pytest

from server.config.kinds import KINDS, KindSettings
from server.config.options import SettingsError
from server.config.settings import Settings, parse


def settings(tmp_path: Path, text: str, *flags: str) -> Settings:
    path = tmp_path / "server.toml"
    path.write_text(text, "utf-8")
    found = parse(["--config", str(path), *flags], {})
    assert isinstance(found, Settings)
    return found


def test_a_server_has_no_kinds_without_such_tables(tmp_path: Path) -> None:
    assert settings(tmp_path, "port = 1").worlds == {}
    assert settings(tmp_path, "[worlds]").worlds == {}
    assert "worlds." not in str(parse(["--print-config"], {}))


def test_a_kind_has_its_values_and_the_defaults(tmp_path: Path) -> None:
    found = settings(
        tmp_path,
        '[worlds.arena]\ngame = "a:B"\nscene = "arena"\nplayers_max = 4\nempty_s = 2\nkeep = true\n'
        "options = { round_s = 90 }\n[worlds.lobby]\nstart = 2\n",
    )
    assert found.worlds == {
        "arena": KindSettings(
            game="a:B", scene="arena", players_max=4, empty_s=2.0, keep=True, options={"round_s": 90}
        ),
        "lobby": KindSettings(start=2),
    }
    assert [*found.worlds] == ["arena", "lobby"]
    assert found.game is None


def test_the_printed_configuration_is_one_that_gives_the_same_settings(tmp_path: Path) -> None:
    text = (
        '[worlds.arena]\ngame = "a:B"\ncreate = false\n[worlds.arena.options]\nround_s = 90\nname = "x \\" y"\n'
        '[worlds.b]\nrecord = "here"\n[limits]\nworlds_max = 3\n'
    )
    found = settings(tmp_path, text)
    again = settings(tmp_path, found.to_toml())
    assert again == found
    assert "create = false  # file " in found.to_toml()
    assert "players_max = 16  # default" in found.to_toml()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("worlds = 3", "worlds = 3 (from FILE): must be tables, such as [worlds.arena]"),
        ("[worlds]\narena = 1", "worlds.arena = 1 (from FILE): must be a table, such as [worlds.arena]"),
        ("[worlds.a]\nplayer_max = 1", "worlds.a.player_max (from FILE): no such setting (did you mean players_max?)"),
        ("[worlds.a]\nxyz = 1", "worlds.a.xyz (from FILE): no such setting (there are game, scene, players_max,"),
        ("[worlds.a]\nplayers_max = 0", "worlds.a.players_max = 0 (from FILE): must be a whole number from 1 to"),
        ('[worlds.a]\nplayers_max = "4"', "worlds.a.players_max = '4' (from FILE): must be a whole number from 1 to"),
        ("[worlds.a]\nworlds_max = 1.5", "worlds.a.worlds_max = 1.5 (from FILE): must be a whole number from 1 to"),
        ("[worlds.a]\nempty_s = -1", "worlds.a.empty_s = -1.0 (from FILE): must be a number from 0 to"),
        ("[worlds.a]\nempty_s = nan", "worlds.a.empty_s = nan (from FILE): must be a number from 0 to"),
        ("[worlds.a]\nkeep = 1", "worlds.a.keep = 1 (from FILE): must be true or false"),
        ("[worlds.a]\ngame = 1", "worlds.a.game = 1 (from FILE): must be a text"),
        ('[worlds.a]\nscene = ""', "worlds.a.scene = '' (from FILE): must be a text"),
        ("[worlds.a]\noptions = 1", "worlds.a.options = 1 (from FILE): must be a table"),
        ("[worlds.a]\noptions = { x = 1 }", "worlds.a.options.x (from FILE): is of a game; set game, too"),
        ("[worlds.a]\nstart = -1", "worlds.a.start = -1 (from FILE): must be a whole number from 0 to"),
    ],
)  # fmt: skip
def test_an_error_names_the_kind_the_setting_the_value_and_the_file(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        settings(tmp_path, text)
    assert str(error.value).replace(f"file {tmp_path / 'server.toml'}", "FILE").startswith(message)


def test_every_setting_of_a_kind_says_what_it_is() -> None:
    assert all(len(option.help) > 10 for option in KINDS.values())
