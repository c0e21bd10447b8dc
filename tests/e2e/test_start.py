"""How a server process starts, or says in one line why not; and its other commands."""

import io
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from server.process import announce_compiling
from shared import kernels
from tests.e2e.processes import ROOT, other, running, stats, until

pytestmark = pytest.mark.e2e


def on_a_terminal(cache: Path) -> list[str]:
    """The lines that somebody sees who starts a server, up to the one that it listens."""
    seen, its = os.openpty()
    command = [sys.executable, "-m", "server", "--port", "0", "--scene", "flat", "--log-level", "warning"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdin=its, stdout=its, stderr=its) as process:
        os.close(its)
        try:
            text = ""
            while "listening on" not in text:
                text += os.read(seen, 1000).decode()
        finally:
            process.terminate()
            os.close(seen)
    return [line.partition(" ")[0] for line in text.splitlines()]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt" or not kernels.available(), reason="needs a terminal, and something to compile")
def test_the_first_start_says_on_a_terminal_what_takes_so_long(tmp_path: Path) -> None:
    assert on_a_terminal(tmp_path) == ["compiling", "listening"]
    assert on_a_terminal(tmp_path) == ["listening"]


def test_a_log_is_not_told() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for stream, lines in ((Terminal(), 1), (io.StringIO(), 0)):
        announce_compiling(stream)
        assert stream.getvalue().count("\n") == lines


def broken(tmp_path: Path, text: str) -> str:
    path = tmp_path / "broken.toml"
    path.write_text(text)
    return str(path)


def fails(*arguments: str, **environment: str) -> str:
    """The one line that a process prints before it ends with exit code 2."""
    with running(*arguments, **environment) as server:
        assert server.end() == 2
        assert server.rest() == []
        assert len(server.errors) == 1, server.errors
        return server.errors[0]


def test_the_log_tells_a_new_world_from_one_that_goes_on(tmp_path: Path) -> None:
    for event in ("a new world", "restored"):
        with running("--port", "0", "--scene", "flat", "--data", str(tmp_path)) as server:
            server.address()
            assert server.end(signal.SIGTERM) == 0
            assert server.log()[0]["event"] == event


def test_bad_settings(tmp_path: Path) -> None:
    assert fails("--port", "x") == "error: port = 'x' (from --port): must be a whole number from 0 to 65535\n"
    assert "--prot 1 (did you mean --port?)" in fails("--prot", "1")
    assert "SOVEREIGN_PROT: there is no such setting (did you mean SOVEREIGN_PORT?)" in fails(SOVEREIGN_PROT="1")
    assert "tick_rate = 0 (from SOVEREIGN_TICK_RATE)" in fails(SOVEREIGN_TICK_RATE="0")
    assert "auth_key_file is not set" in fails("--auth", "token")
    assert "auth = 'no.such:thing': cannot be used" in fails("--auth", "no.such:thing")
    assert "tls_cert = 'nowhere'" in fails("--tls-cert", "nowhere", "--tls-key", "nowhere")
    assert "no_such" in fails("--config", broken(tmp_path, "no_such = 1"))


def test_bad_commands() -> None:
    assert fails("chek") == (
        "error: 'chek': no such command (did you mean check?); there are token and check, or just flags (--help)\n"
    )
    assert fails("my_game:Tag").startswith("error: 'my_game:Tag': no such command; there are")
    assert "are required: --subject; --help lists all flags" in fails("token")
    assert "--urk x (did you mean --url?)" in fails("check", "--urk", "x")


def test_bad_scenes(tmp_path: Path) -> None:
    assert "'nowhere'" in fails("--scene", "nowhere")
    assert "not valid TOML" in fails("--scene", broken(tmp_path, "x ="))
    assert "gravity" in fails("--scene", broken(tmp_path, 'gravity = "much"'))
    assert "gravity" in fails("--scene", broken(tmp_path, "gravity = 0.0001"), "--tick-rate", "240")


def test_bad_addresses() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        line = fails("--scene", "flat", "--port", port)
        assert line == (
            f"error: host = '127.0.0.1', port = {port}: in use by another program, so end that one or choose another "
            "--port (0: any that is free)\n"
        )
    assert "no.such.host.invalid" in fails("--scene", "flat", "--host", "no.such.host.invalid")
    assert "a..b" in fails("--scene", "flat", "--host", "a..b")


def test_check_says_whether_a_server_is_ready() -> None:
    with running("--port", "0", "--scene", "flat") as server:
        port = server.address()[1]
        url = f"ws://127.0.0.1:{port}"
        until(lambda: stats(("127.0.0.1", port))["ready"])
        assert other("check", "--url", url) == (0, ["ready\n"])
        assert other("check", SOVEREIGN_PORT=str(port)) == (0, ["ready\n"])
        assert other("check", "--url", f"http://127.0.0.1:{port}/x") == (1, ["/x: no such page\n"])
        assert server.end(signal.SIGTERM) == 0
    code, lines = other("check", "--url", url)
    assert (code, len(lines)) == (1, 1)
    assert "no answer" in lines[0]
