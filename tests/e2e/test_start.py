"""The start of a server process, or its one-line error; and its other commands."""

import contextlib
import http.client
import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from client_sdk.client import Client
from server.runtime.event_loop import COMPILING, announce_compiling
from tests.e2e.processes import ROOT, START_S, other, page, running, stats
from tests.lengths import long
from tests.patience import until

pytestmark = pytest.mark.e2e


def test_a_terminal_gets_plain_text_and_anything_else_a_line_of_the_log(caplog: pytest.LogCaptureFixture) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    caplog.set_level("INFO")
    for stream, shown, logged in ((Terminal(), f"{COMPILING} ...\n", []), (io.StringIO(), "", [COMPILING])):
        announce_compiling(stream)
        assert stream.getvalue() == shown
        assert caplog.messages == logged


PAGE_IS = [
    (("--host", "::1"), "http://[::1]:{port}/"),
    (("--page", "false"), None),
    *long(
        ((), "http://127.0.0.1:{port}/"),
        (("--host", "localhost"), "http://localhost:{port}/"),
        (("--host", "0.0.0.0", "--auth", "none"), "http://127.0.0.1:{port}/"),
        (("--host", "0.0.0.0", "--auth", "none", "--figures", "loopback"), "http://127.0.0.1:{port}/"),
        (("--host", "::", "--auth", "none"), "http://127.0.0.1:{port}/"),
        (("--figures", "none"), None),
    ),
]


@pytest.mark.parametrize(("flags", "shown"), PAGE_IS)
def test_it_says_where_its_live_page_is(flags: tuple[str, ...], shown: str | None) -> None:
    if "::" in "".join(flags) and not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6")
    with running("--port", "0", "--scene", "flat", "--play", "false", *flags) as server:
        host, port = server.address()
        assert host == (flags[1] if "--host" in flags else "127.0.0.1")
        if shown is not None:
            line = server.out.get(timeout=START_S)
            assert line == f"live page at {shown.format(port=port)}\n"
            with urllib.request.urlopen(line.split()[-1], timeout=START_S) as answer:
                assert b"<canvas" in answer.read()
        assert server.end(signal.SIGTERM) == 0
        assert server.rest() == []


def test_every_interface_is_reached_by_both_families() -> None:
    if not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6")
    with running("--port", "0", "--scene", "flat", "--host", "::", "--auth", "none") as server:
        _, port = server.address()
        for host in ("127.0.0.1", "[::1]"):
            assert page((host, port), "/healthz") == "ok\n"
            with Client.connect(f"ws://{host}:{port}"):
                pass
        assert server.end(signal.SIGTERM) == 0


def test_pages_are_refused_by_a_name_of_somebody_else_until_it_is_allowed() -> None:
    def asked(port: int, host: str) -> int:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=START_S)
        with contextlib.closing(connection):
            connection.request("GET", "/stats", headers={"Host": host})
            return connection.getresponse().status

    with running("--port", "0", "--scene", "flat", SOVEREIGN_ALLOWED_HOSTS="game,play.example") as server:
        port = server.address()[1]
        hosts = ("evil.example", f"game:{port}", "play.example", "127.0.0.1", "localhost")
        assert [asked(port, host) for host in hosts] == [421, 200, 200, 200, 200]
        assert stats(("127.0.0.1", port))["refused_at_door"] == {"host": 1}
        assert server.end(signal.SIGTERM) == 0


@pytest.mark.parametrize("folder", [".venv", ""])
def test_a_library_that_is_missing_is_named_with_a_way_that_works(tmp_path: Path, folder: str) -> None:
    shutil.copytree(ROOT / "server", tmp_path / "server", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / folder).mkdir(exist_ok=True)
    program = "import runpy, sys; sys.modules['structlog'] = None; runpy.run_module('server', run_name='__main__')"
    ways = {".venv": ". .venv/bin/activate (it is in .venv)", "": f"pip install '{tmp_path}[server]'"}
    for project in (True, False):
        if project:
            (tmp_path / "pyproject.toml").touch()
        else:
            (tmp_path / "pyproject.toml").unlink()
            ways[""] = (
                "pip install 'PATH[server]', where PATH is the repository or the wheel that this was installed from"
            )
        done = subprocess.run(
            [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 1
        assert done.stderr == f"error: the server needs structlog, which is not installed here: {ways[folder]}\n"


def test_nothing_advises_to_install_a_name_that_is_on_no_index() -> None:
    sources = [path for path in ROOT.glob("*/**/*") if path.suffix in (".py", ".md", ".mjs", ".html", ".toml")]
    own = [path for path in (*sources, *ROOT.glob("*.md")) if not path.relative_to(ROOT).parts[0].startswith(".")]
    advised = re.compile(r"pip install (?:--\S+ )*'?sovereign")
    assert [path for path in own if path != Path(__file__) and advised.search(path.read_text("utf-8"))] == []


def broken(tmp_path: Path, name: str, text: str) -> str:
    path = tmp_path / f"{name}.toml"
    path.write_text(text)
    return str(path)


Start = tuple[tuple[str, ...], dict[str, str]]
"""Arguments of `python -m server`, and variables of its environment."""
STARTS = """
import contextlib, io, json, os, sys
from server.app import main
told = []
for arguments, variables in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    os.environ.update(variables)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(arguments)
    for name in variables:
        del os.environ[name]
    told.append([code, out.getvalue(), err.getvalue()])
json.dump(told, sys.stdout)
"""
"""Program that runs the given starts one after another in one process."""


def start(*arguments: str, **variables: str) -> Start:
    return arguments, variables


def ended(*starts: Start) -> list[tuple[int, str, str]]:
    """Returns the exit code, the output and the errors of each start."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("SOVEREIGN_")}
    done = subprocess.run(
        (sys.executable, "-c", STARTS), cwd=ROOT, env=clean, input=json.dumps(starts), capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return [(code, out, err) for code, out, err in json.loads(done.stdout)]


def fail(*cases: tuple[Start, str]) -> None:
    """Checks that each start ends with exit code 2 and prints one line, which has this text."""
    for (code, out, err), (case, text) in zip(ended(*(case for case, _ in cases)), cases, strict=True):
        assert (code, out) == (2, ""), case
        assert text in err, case
        assert err.startswith("error: "), case
        assert err.count("\n") == 1, err


def test_the_log_tells_a_new_world_from_one_that_goes_on(tmp_path: Path) -> None:
    for event in ("a new world", "restored"):
        with running("--port", "0", "--scene", "flat", "--data", str(tmp_path)) as server:
            server.address()
            assert server.end(signal.SIGTERM) == 0
            assert server.log()[0]["event"] == event


def test_a_failed_start_is_one_line_and_exit_code_2() -> None:
    with running("--port", "x") as server:
        assert server.end() == 2
        assert server.rest() == []
        assert server.errors == ["error: port = 'x' (from --port): must be a whole number from 0 to 65535\n"]


def test_bad_settings(tmp_path: Path) -> None:
    fail(
        (start("--prot", "1"), "--prot 1 (did you mean --port?)"),
        (start(SOVEREIGN_PROT="1"), "SOVEREIGN_PROT: there is no such setting (did you mean SOVEREIGN_PORT?)"),
        (start(SOVEREIGN_TICK_RATE="0"), "tick_rate = 0 (from SOVEREIGN_TICK_RATE)"),
        (start("--auth", "token"), "neither auth_key_file nor"),
        (start("--auth", "no.such:thing"), "auth = 'no.such:thing': cannot be used"),
        (start("--tls-cert", "nowhere", "--tls-key", "nowhere"), "tls_cert = 'nowhere'"),
        (start("--config", broken(tmp_path, "config", "no_such = 1")), "no_such"),
    )


def test_bad_commands() -> None:
    unknown = (
        "error: 'chek': no such command (did you mean check?); the commands are token, check, describe and worlds; "
        "to start a server, give only flags (--help)\n"
    )
    fail(
        (start("chek"), unknown),
        (start("my_game:Tag"), "error: 'my_game:Tag': no such command; the commands are"),
        (start("token"), "are required: --subject; --help lists all flags"),
        (start("check", "--urk", "x"), "--urk x (did you mean --url?)"),
    )


def test_bad_scenes(tmp_path: Path) -> None:
    fail(
        (start("--scene", "nowhere"), "'nowhere'"),
        (start("--scene", broken(tmp_path, "text", "x =")), "not valid TOML"),
        (start("--scene", broken(tmp_path, "type", 'gravity = "much"')), "gravity"),
        (start("--scene", broken(tmp_path, "range", "gravity = 0.0001"), "--tick-rate", "240"), "gravity"),
    )


def test_bad_addresses() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        in_use = (
            f"error: host = '127.0.0.1', port = {port}: in use by another program; end that one or choose another "
            "--port (0: any free one)\n"
        )
        fail(
            (start("--scene", "flat", "--port", port), in_use),
            (start("--scene", "flat", "--host", "no.such.host.invalid"), "no.such.host.invalid"),
            (start("--scene", "flat", "--host", "a..b"), "a..b"),
        )


def test_check_says_whether_a_server_is_ready() -> None:
    with running("--port", "0", "--scene", "flat") as server:
        port = server.address()[1]
        url = f"ws://127.0.0.1:{port}"
        until(lambda: stats(("127.0.0.1", port))["ready"])
        assert ended(
            start("check", "--url", url),
            start("check", SOVEREIGN_PORT=str(port)),
            start("check", "--url", f"http://127.0.0.1:{port}/x"),
        ) == [(0, "ready\n", ""), (0, "ready\n", ""), (1, "/x: no such page\n", "")]
        assert server.end(signal.SIGTERM) == 0
    code, lines = other("check", "--url", url)
    assert (code, len(lines)) == (1, 1)
    assert "no answer" in lines[0]
