"""Settings: which source wins, and the text of an error."""

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.config.limits import Limits
from server.config.options import SettingsError, checked
from server.config.settings import GROUPS, KINDS, SECTIONS, Settings, load, parse
from shared import kernels


def config(tmp_path: Path, text: str) -> str:
    path = tmp_path / "server.toml"
    path.write_text(text, "utf-8")
    return str(path)


def settings(arguments: list[str], environment: dict[str, str] | None = None) -> Settings:
    found = parse(arguments, environment or {})
    assert isinstance(found, Settings)
    return found


def test_defaults() -> None:
    assert settings([]) == Settings("127.0.0.1", 8765, "hills", None, limits=Limits())
    assert settings([]).origins == {}
    defaults = parse(["--print-config"], {})
    assert isinstance(defaults, str)
    assert all(name in defaults for name in KINDS)
    assert sum(map(len, SECTIONS.values())) == len(KINDS), "a name has one meaning in all sources"


def test_the_settings_name_the_kernel_that_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    printed = parse(["--print-config"], {})
    assert f'kernel = "auto"  # default; runs: {kernels.describe("auto")}\n' in str(printed)
    printed = parse(["--print-config"], {"SOVEREIGN_KERNEL": "plain"})
    assert 'kernel = "plain"  # SOVEREIGN_KERNEL; runs: plain' in str(printed)
    monkeypatch.setattr(kernels, "trouble", lambda: "no prebuilt kernel for here")
    with pytest.raises(SettingsError, match=r"^kernel = 'prebuilt' \(from --kernel\): no prebuilt kernel for here$"):
        settings(["--kernel", "prebuilt"])


def test_each_source_wins_over_the_one_before(tmp_path: Path) -> None:
    path = config(tmp_path, 'host = "a"\nport = 1\nscene = "flat"\ntick_rate = 10')
    environment = {"SOVEREIGN_PORT": "2", "SOVEREIGN_SCENE": "arena", "SOVEREIGN_AUTH": "none", "UNRELATED": "x"}
    found = settings(["--config", path, "--scene", "topdown"], environment)
    assert (found.host, found.port, found.scene, found.tick_rate) == ("a", 2, "topdown", 10)
    assert found.origins == {
        "host": f"file {path}",
        "port": "SOVEREIGN_PORT",
        "scene": "--scene",
        "auth": "SOVEREIGN_AUTH",
        "tick_rate": f"file {path}",
    }


def test_an_ipv6_address_may_stand_in_brackets_as_in_a_url() -> None:
    assert settings(["--host", "[::1]"]).host == settings(["--host", "::1"]).host == "::1"
    with pytest.raises(SettingsError, match="host = '::'"):
        settings(["--host", "[::]"])


def test_the_environment_can_name_the_file_and_the_flag_wins(tmp_path: Path) -> None:
    path = config(tmp_path, "port = 7")
    assert settings([], {"SOVEREIGN_CONFIG": path}).port == 7
    with pytest.raises(SettingsError, match="nowhere"):
        parse(["--config", "nowhere.toml"], {"SOVEREIGN_CONFIG": path})


@pytest.mark.parametrize(
    ("arguments", "environment", "message"),
    [
        (["--port", "x"], {}, "port = 'x' (from --port): must be a whole number from 0 to 65535"),
        (["--port", "65536"], {}, "port = 65536 (from --port): must be a whole number from 0 to 65535"),
        (["--port=-1"], {}, "port = -1 (from --port): must be a whole number from 0 to 65535"),
        (["--port", "8e3"], {}, "port = '8e3' (from --port): must be a whole number from 0 to 65535"),
        (["--port", "٣"], {}, "port = '٣' (from --port): must be a whole number from 0 to 65535"),
        (["--tick-rate", "0"], {}, "tick_rate = 0 (from --tick-rate): must be a whole number from 1 to 240"),
        (["--host", ""], {}, "host = '' (from --host): must be a text without spaces around it"),
        ([], {"SOVEREIGN_PORT": ""}, "port = '' (from SOVEREIGN_PORT): must be a whole number from 0 to 65535"),
        (
            [],
            {"SOVEREIGN_LOOPBACK_EXEMPT": "maybe"},
            "loopback_exempt = 'maybe' (from SOVEREIGN_LOOPBACK_EXEMPT): must be true or false",
        ),
        (["--hello-s", "nan"], {}, "hello_s = 'nan' (from --hello-s): must be a number from 0.1 to 3600"),
        (["--hello-s", "inf"], {}, "hello_s = 'inf' (from --hello-s): must be a number from 0.1 to 3600"),
        (["--hello-s", "0"], {}, "hello_s = 0.0 (from --hello-s): must be a number from 0.1 to 3600"),
        (["--clients-max", "0"], {}, "clients_max = 0 (from --clients-max): must be a whole number from 1 to 1000000"),
        (["--clients-max", "1.5"], {}, "clients_max = '1.5' (from --clients-max): must be a whole number from 1 to"),
        (
            ["--allowed-origins", "a,,b"],
            {},
            "allowed_origins = ('a', '', 'b') (from --allowed-origins): must be a list of texts without spaces",
        ),
        (
            ["--allowed-hosts", "play.example,http://play.example"],
            {},
            "allowed_hosts = 'http://play.example' (from --allowed-hosts): must be a host name, without scheme",
        ),
        (
            ["--allowed-hosts", "play.example:8765"],
            {},
            "allowed_hosts = 'play.example:8765' (from --allowed-hosts): must",
        ),
        (
            [],
            {"SOVEREIGN_ALLOWED_HOSTS": "*.example"},
            "allowed_hosts = '*.example' (from SOVEREIGN_ALLOWED_HOSTS): must",
        ),
        (
            ["--log-level", "loud"],
            {},
            "log_level = 'loud' (from --log-level): must be one of debug, info, warning, error",
        ),
        (["--prot", "1"], {}, "unrecognized arguments: --prot 1 (did you mean --port?); --help lists all flags"),
        (["--tick", "1"], {}, "unrecognized arguments: --tick 1"),
        (["--zzz=1"], {}, "unrecognized arguments: --zzz=1; --help lists all flags"),
        (["--port"], {}, "argument --port: expected one argument; --help lists all flags"),
    ],
)
def test_a_mistake_names_the_setting_its_origin_and_the_value(
    arguments: list[str], environment: dict[str, str], message: str
) -> None:
    with pytest.raises(SettingsError) as error:
        parse(arguments, environment)
    assert str(error.value).startswith(message)


def test_a_variable_that_is_no_setting_is_named_with_the_one_that_may_have_been_meant() -> None:
    known = {"SOVEREIGN_AUTH_KEY": "k" * 32, "SOVEREIGN": "1", "SOVEREIGNTY": "1", "OTHER_SOVEREIGN_X": "1"}
    assert settings([], known).origins == {}
    for variable, meant in {
        "SOVEREIGN_PROT": " (did you mean SOVEREIGN_PORT?)",
        "SOVEREIGN_TICKRATE": " (did you mean SOVEREIGN_TICK_RATE?)",
        "SOVEREIGN_CONFG": " (did you mean SOVEREIGN_CONFIG?)",
        "SOVEREIGN_port": " (did you mean SOVEREIGN_PORT?)",
        "SOVEREIGN_": "",
        "SOVEREIGN_URK": "",
    }.items():
        with pytest.raises(SettingsError) as error:
            parse([], {variable: "1"})
        assert str(error.value) == f"{variable}: there is no such setting{meant}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("prot = 1", "prot (from file {path}): no such setting (did you mean port?)"),
        ('port = "8765"', "port = '8765' (from file {path}): must be a whole number from 0 to 65535"),
        ("port = true", "port = True (from file {path}): must be a whole number from 0 to 65535"),
        (
            "[limits]\nloopback_exempt = 1",
            "loopback_exempt = 1 (from file {path}): must be true or false",
        ),
        ("[limits]\nhello_s = nan", "hello_s = nan (from file {path}): must be a number from 0.1 to 3600"),
        ("[limits]\nhello_s = true", "hello_s = True (from file {path}): must be a number from 0.1 to 3600"),
        ("[limits]\nport = 1", "port (from [limits] in file {path}): no such setting (there are connections_max, "),
        ("clients_max = 1", "clients_max (from file {path}): no such setting (there are host, port, "),
        ("limits = 1", "limits (from file {path}): no such setting (there are host, port, "),
        ('allowed_origins = "a"', "allowed_origins = 'a' (from file {path}): must be a list of texts"),
        ("host = 1", "host = 1 (from file {path}): must be a text without spaces around it"),
        ("log_level = []", "log_level = [] (from file {path}): must be one of debug, info, warning, error"),
        ("origins = {}", "origins (from file {path}): no such setting (did you mean allowed_origins?)"),
        ("port = ", "config = '{path}': not valid TOML ("),
        ("port = 1\nport = 2", "config = '{path}': not valid TOML ("),
    ],
)
def test_a_mistake_in_the_file_names_the_file(tmp_path: Path, text: str, message: str) -> None:
    path = config(tmp_path, text)
    with pytest.raises(SettingsError) as error:
        load({}, {}, path)
    assert str(error.value).startswith(message.format(path=path))


def test_a_file_that_is_not_text_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(SettingsError, match="not valid TOML"):
        load({}, {}, str(path))
    with pytest.raises(SettingsError, match="cannot be read"):
        load({}, {}, str(tmp_path))


@pytest.mark.parametrize(("word", "value"), [("TRUE", True), ("1", True), ("no", False), ("false", False)])
def test_truth_from_the_environment(word: str, value: bool) -> None:
    assert settings([], {"SOVEREIGN_LOOPBACK_EXEMPT": word}).limits.loopback_exempt is value


def test_a_flag_of_truth_needs_no_value() -> None:
    environment = {"SOVEREIGN_LOOPBACK_EXEMPT": "no"}
    assert settings(["--loopback-exempt", "--port", "1"], environment).limits.loopback_exempt is True
    assert settings(["--loopback-exempt", "false"]).limits.loopback_exempt is False


TEXTS = st.text(max_size=12) | st.from_regex(r"-?[0-9]{0,25}(\.[0-9]*)?(e[0-9]{1,4})?", fullmatch=True)
TOML_VALUES = st.recursive(
    st.one_of(TEXTS, st.integers(), st.floats(), st.booleans()), lambda inner: st.lists(inner, max_size=3), max_leaves=4
)


@given(st.dictionaries(st.sampled_from(sorted(KINDS)), TEXTS, max_size=6))
def test_any_text_is_a_setting_that_reads_back_or_an_error_that_names_it(values: dict[str, str]) -> None:
    try:
        found = load({}, {"SOVEREIGN_" + name.upper(): text for name, text in values.items()})
    except SettingsError as error:
        assert any(name in str(error) for name in values)  # noqa: PT017 - or it is a setting
        return
    with TemporaryDirectory() as folder:
        path = Path(folder) / "server.toml"
        path.write_text(found.to_toml(), "utf-8")
        again = load({"auth": found.auth}, {}, str(path))
    assert again == found


@given(st.sampled_from(sorted(KINDS)), TOML_VALUES)
def test_any_value_of_a_file_is_a_setting_or_an_error_that_names_it(name: str, value: object) -> None:
    try:
        found = checked(name, KINDS[name], value, "file x")
    except SettingsError as error:
        assert str(error).startswith(f"{name} = ")  # noqa: PT017 - or it is a setting
        return
    assert checked(name, KINDS[name], list(found) if isinstance(found, tuple) else found, "file x") == found


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.1", "play.example"])
def test_a_reachable_server_needs_a_choice_of_who_may_play(host: str) -> None:
    with pytest.raises(SettingsError, match="say who may play"):
        parse(["--host", host], {})
    assert settings(["--host", host, "--auth", "none"]).auth == "none"
    assert settings(["--host", host], {"SOVEREIGN_AUTH": "token"}).auth == "token"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "::1", "localhost"])
def test_anyone_may_play_where_only_this_machine_is(host: str) -> None:
    assert settings(["--host", host]).auth == "none"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--auth", "x"], "auth = 'x' (from --auth): must be none, token, or MODULE:NAME"),
        (["--auth", ":x"], "auth = ':x' (from --auth): must be none, token, or MODULE:NAME"),
        (["--tls-cert", "c"], "tls_cert (from --tls-cert): needs tls_key as well"),
        (["--tls-key", "k"], "tls_key (from --tls-key): needs tls_cert as well"),
    ],
)
def test_settings_that_need_each_other(arguments: list[str], message: str) -> None:
    with pytest.raises(SettingsError) as error:
        parse(arguments, {})
    assert str(error.value) == message


def test_limits_stand_in_a_table_of_their_own(tmp_path: Path) -> None:
    path = config(tmp_path, 'port = 1\nallowed_origins = ["https://a.b"]\n[limits]\nhello_s = 2\nclients_max = 7')
    found = settings(["--config", path, "--clients-max", "8"], {"SOVEREIGN_SILENCE_S": "1.5"})
    assert found.limits == Limits(hello_s=2.0, clients_max=8, silence_s=1.5)
    assert found.allowed_origins == ("https://a.b",)
    assert settings([], {"SOVEREIGN_ALLOWED_ORIGINS": "https://a.b, http://c"}).allowed_origins == (
        "https://a.b",
        "http://c",
    )


def test_the_printed_configuration_reads_back(tmp_path: Path) -> None:
    arguments = ["--scene", 'C:\\new "x"\t.toml', "--tick-rate", "60", "--joins-per-s", "2.5"]
    arguments += ["--allowed-origins", 'https://a.b,"c"', "--loopback-exempt", "no"]
    text = parse([*arguments, "--print-config"], {})
    assert isinstance(text, str)
    assert "tick_rate = 60  # --tick-rate" in text
    assert settings(["--config", config(tmp_path, text)]) == settings(arguments)


def test_help_and_scenes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        parse(["--help"], {})
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert all(name in KINDS for names in GROUPS.values() for name in names)
    assert all("--" + name.replace("_", "-") in text for name in KINDS)
    listed = parse(["--list-scenes"], {"SOVEREIGN_PORT": "broken"})
    assert isinstance(listed, str)
    named = {line.split()[0]: line for line in listed.splitlines() if not line.startswith(" ")}
    assert named.keys() >= {"flat", "hills", "arena", "topdown", "meadow"}
    assert named["flat"].endswith("A plain: one floor, nothing in the way")


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        ({"role": "edge"}, "role = 'edge' .*needs bus"),
        ({"bus": "nats://127.0.0.1:4222"}, "bus .*needs role"),
        ({"public_url": "ws://x"}, "public_url .*needs role"),
        ({"role": "edge", "bus": "nats://x", "data": "there"}, "role = 'edge' .*excludes data"),
        ({"role": "standby", "bus": "nats://x", "public_url": "ws://x"}, "public_url .*role edge only"),
        ({"role": "king", "bus": "nats://x"}, "role = 'king' .*one of server, sequencer, edge, standby"),
    ],
)
def test_settings_of_parts_that_exclude_or_need_each_other(flags: dict[str, str], reason: str) -> None:
    with pytest.raises(SettingsError, match=reason):
        load(flags, {})
