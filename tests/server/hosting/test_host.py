"""The host of many worlds: ticks, rest, failures, saved worlds, recordings, and that nothing is left of an end."""

import gc
import json
import logging
import threading
from pathlib import Path

import pytest

from server.config.options import SettingsError
from server.hosting.declared import declared_kinds
from server.runtime.log import WORLD
from server.runtime.ticker import FAILURES_MAX
from server.worlds.kinds import WorldsError
from shared import messages
from sovereign_netcode.replay import main as replay
from tests.server.hosting.bench import BROKEN, GAMES, KEEPING, PLAIN, Alarm, Bench, Broken

pytestmark = pytest.mark.usefixtures("alarms")


# -- ticks ---------------------------------------------------------------------------------------------------


def test_worlds_tick_while_somebody_is_in_them_and_their_deadlines_are_spread(
    tmp_path: Path, alarms: list[Alarm]
) -> None:
    bench = Bench(tmp_path, PLAIN)
    names = [bench.worlds.create("plain").name for _ in range(4)]
    assert not alarms
    joined = [bench.join(f"/{name}") for name in names]
    assert len(alarms) == 4
    phases = sorted(alarm.at * 32 % 1 for alarm in alarms)
    assert phases == [0.0, 0.25, 0.5, 0.75]
    _, way, session = joined[1]
    way.lost(session, bench.now)
    bench.tick(names[1])
    bench.pass_s(0.1)
    assert sorted(alarm.at * 32 % 1 for alarm in alarms) == [0.0, 0.25, 0.75]
    assert not bench.worlds.worlds[names[1]].ticking
    bench.join(f"/{names[1]}")
    assert len(alarms) == 4
    bench.close()
    assert not alarms


def test_the_lines_of_the_log_have_the_name_of_the_world_whose_tick_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path, GAMES)
    bench.worlds.create("duel", name="a")
    seen: list[str] = []
    monkeypatch.setattr(bench.game("a").clocks, "refill", lambda: seen.append(WORLD.get()))
    bench.tick("a")
    assert (seen, WORLD.get()) == (["a"], "")
    bench.close()


def test_a_world_whose_ticks_fail_ends_alone_and_its_data_are_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    bench = Bench(tmp_path, PLAIN, data)
    for name in ("bad", "good"):
        bench.worlds.create("plain", name=name)
    link, *_ = bench.join("/bad")
    other, *_ = bench.join("/good")

    def fails(inputs: object = None) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(bench.game("bad").world, "step", fails)
    with caplog.at_level(logging.CRITICAL, "server.observability.errors"):
        bench.tick("bad", FAILURES_MAX - 1)
        assert "bad" in bench.worlds.worlds
        bench.tick("bad")
    assert link.bye.code == messages.ENDED
    assert link.bye.reason == f"{FAILURES_MAX} ticks in a row have failed"
    assert [*bench.worlds.worlds] == ["good"]
    bench.tick("good")
    assert not other.closings
    assert bench.files() == ["good"]
    assert [path.name for path in (data / "failed-worlds").iterdir()] == ["bad"]
    bench.worlds.create("plain", name="bad")  # the name is free, and the new world is a new one
    assert bench.game("bad").world.tick == 0
    bench.close()


# -- worlds that cannot be made ------------------------------------------------------------------------------


def test_a_world_whose_rules_fail_is_not_made_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path, BROKEN + PLAIN, tmp_path / "data")
    monkeypatch.setattr(Broken, "fails", True)
    descriptors = _descriptors()
    for _ in range(3):
        with pytest.raises(WorldsError, match=r"the world 'broken-[123]' cannot be made: game = .*: no licence"):
            bench.worlds.create("broken")
    assert (bench.files(), bench.host.running, [*bench.worlds.worlds]) == ([], {}, [])
    assert _descriptors() == descriptors
    bench.worlds.create("plain")
    bench.close()


def test_a_world_whose_directory_cannot_be_used_is_not_made(tmp_path: Path) -> None:
    bench = Bench(tmp_path, PLAIN, tmp_path / "data")
    (tmp_path / "data" / "worlds" / "a").write_text("in the way")
    with pytest.raises(WorldsError, match="the world 'a' cannot be made"):
        bench.worlds.create("plain", name="a")
    bench.worlds.create("plain", name="b")
    bench.close()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[worlds.Arena]\nscene = "arena"', "worlds.Arena (from FILE): kind = 'Arena': must be 1 to 32 small letters"),
        ('[worlds.match]\nscene = "nowhere"', "worlds.match (from FILE): scene 'nowhere': cannot be read"),
        ('[worlds.stats]\nscene = "arena"', "worlds.stats (from FILE): kind = 'stats': is a path of the server"),
        ('[worlds.a]\ngame = "no:Game"', "worlds.a (from FILE): game = 'no:Game': cannot be loaded"),
        (GAMES + "options = { x = 1 }", "worlds.duel (from FILE): game = "),
    ],
)
def test_a_kind_that_cannot_be_used_is_named_at_the_start(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        Bench(tmp_path, text)
    assert str(error.value).replace(f"file {tmp_path / 'server.toml'}", "FILE").startswith(message)


def test_each_world_of_a_kind_has_rules_and_random_numbers_of_its_own(tmp_path: Path) -> None:
    bench = Bench(tmp_path, GAMES)
    for name in ("a", "b"):
        bench.worlds.create("duel", name=name)
    assert bench.game("a").api._rules is not bench.game("b").api._rules
    assert bench.game("a").api._seed != bench.game("b").api._seed
    again = Bench(tmp_path, GAMES)
    again.worlds.create("duel", name="b")
    assert again.game("b").api._seed == bench.game("b").api._seed
    kinds = declared_kinds(bench.settings)
    assert kinds["duel"].scene.name == "arena"


# -- saved worlds --------------------------------------------------------------------------------------------


def test_all_worlds_come_back_after_a_restart_as_they_were(tmp_path: Path) -> None:
    data = tmp_path / "data"
    bench = Bench(tmp_path, GAMES + KEEPING, data)
    one = bench.worlds.create("duel", {"mode": "2v2", "ranked": True, "level": 3}, name="one")
    code = bench.worlds.create("duel", private=True, name="two").code
    bench.worlds.create("keeping", name="three")
    bench.join("/one", "Ann")
    bench.tick("one", 5)
    bench.game("one").world.set_block(3, 3, 0, 4)
    bench.tick("one")
    one.locked = True
    one.properties = {"mode": "ffa"}
    bench.pass_s(0.1)
    state = bench.game("one").world.state_hash()
    bench.close()
    again = Bench(tmp_path, GAMES + KEEPING, data)
    assert {name: world.kind.name for name, world in again.worlds.worlds.items()} == {
        "one": "duel", "two": "duel", "three": "keeping",
    }  # fmt: skip
    world = again.worlds.worlds["one"]
    assert (world.properties, world.locked, world.code) == ({"mode": "ffa"}, True, "")
    assert again.worlds.coded(code).name == "two"
    assert again.game("one").world.state_hash() == state
    assert [player.name for player in again.game("one").players.values()] == ["Ann"]
    assert world.ticking, "a player may reconnect"
    assert not again.worlds.worlds["two"].ticking
    again.close()


def test_a_world_that_ends_takes_its_data_with_it_unless_they_are_kept(tmp_path: Path) -> None:
    data = tmp_path / "data"
    bench = Bench(tmp_path, PLAIN + KEEPING, data)
    bench.worlds.create("plain", name="gone")
    code = bench.worlds.create("keeping", private=True, name="kept").code
    bench.worlds.restore("other", bench.worlds.kinds["plain"], {}, "")
    bench.game("kept").world.set_block(3, 3, 0, 4)
    changed = bench.game("kept").world.state_hash()
    bench.pass_s(4.9)
    assert bench.files() == ["gone", "kept", "other"]
    bench.worlds.worlds["other"].stays = True
    bench.pass_s(0.2)
    assert bench.files() == ["kept", "other"]
    assert ([*bench.worlds.asleep], [*bench.worlds.worlds]) == (["kept"], ["other"])
    bench.pass_s(0.1)
    assert not bench.host._closing
    bench.close()

    again = Bench(tmp_path, PLAIN + KEEPING, data)
    assert ([*again.worlds.asleep], [*again.worlds.worlds]) == (["kept"], ["other"])
    assert again.worlds.coded(code).name == "kept"
    assert again.game("kept").world.state_hash() == changed
    again.worlds.end("kept", "an operator says so")
    assert again.files() == ["other"]
    again.close()


def test_a_world_comes_back_while_its_files_are_being_closed(tmp_path: Path) -> None:
    bench = Bench(tmp_path, KEEPING, tmp_path / "data")
    bench.worlds.create("keeping", name="a")
    for n in range(1, 6):
        bench.game("a").world.set_block(n, 3, 0, 4)
        state = bench.game("a").world.state_hash()
        bench.worlds.end("a", "rests", keep=True)
        assert bench.worlds.get("a").name == "a"
        assert bench.game("a").world.state_hash() == state
    bench.close()


def test_saved_worlds_that_cannot_be_used_are_logged_and_left_and_the_others_come_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = tmp_path / "data"
    bench = Bench(tmp_path, PLAIN + KEEPING, data)
    names = ["alien", "broken", "damaged", "empty", "good", "old", "spoilt"]
    for name in names:
        bench.worlds.create("keeping" if name == "alien" else "plain", name=name)
    bench.close()
    folder = data / "worlds"
    (folder / "broken" / "world.json").write_text("{")
    (folder / "damaged" / "world.db").write_bytes(b"x" * 5000)
    (folder / "empty" / "world.json").unlink()
    (folder / "old" / "world.json").write_text(json.dumps({"format": 0}))
    table = json.loads((folder / "spoilt" / "world.json").read_text())
    (folder / "spoilt" / "world.json").write_text(json.dumps(table | {"properties": {"a": [1]}}))
    (folder / ".ended-x").mkdir()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"}
    with caplog.at_level(logging.ERROR):
        again = Bench(tmp_path, PLAIN, data)
    assert [*again.worlds.worlds] == ["good"]
    text = caplog.text
    assert all(name in text for name in names if name != "good")
    assert "is of the kind keeping, which is not declared" in text
    again.close()
    for path, content in before.items():
        if "good" not in path.parts:
            assert path.read_bytes() == content, path
    assert not (folder / ".ended-x").exists()


def test_trouble_with_a_disk_is_reported(tmp_path: Path) -> None:
    bench = Bench(tmp_path, PLAIN, tmp_path / "data")
    bench.worlds.create("plain", name="a")
    assert bench.host.trouble() == ""
    store = bench.host.running["a"].store
    assert store is not None
    store.trouble = "disk full"
    assert bench.host.trouble() == "cannot save the world a: disk full"
    store.trouble = ""
    bench.close()


# -- recordings ----------------------------------------------------------------------------------------------


def test_each_world_has_a_recording_that_ends_in_the_same_hash(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(tmp_path, f'{PLAIN}record = "{tmp_path / "runs"}"\n')
    for _ in range(2):
        bench.worlds.create("plain", name="a")
        bench.join("/a")
        bench.tick("a", 40)
        bench.worlds.end("a", "over")
    files = sorted((tmp_path / "runs").iterdir())
    assert [path.name for path in files] == ["a-2.rec", "a.rec"]
    for path in files:
        assert replay([str(path)]) == 0
    bench.close()


# -- nothing is left -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("saved", [False, True])
def test_worlds_that_end_leave_no_thread_no_descriptor_and_no_mapping(
    tmp_path: Path, saved: bool, alarms: list[Alarm]
) -> None:
    bench = Bench(tmp_path, PLAIN, tmp_path / "data" if saved else None)

    def play() -> None:
        name = bench.worlds.create("plain").name
        _, way, session = bench.join(f"/{name}")
        bench.tick(name, 3)
        way.lost(session, bench.now)
        bench.tick(name)
        bench.pass_s(0.1)
        bench.pass_s(5.1)
        assert name not in bench.worlds.worlds

    def left() -> tuple[int, int, int, int]:
        if saved:
            assert bench.files() == []
        bench.pass_s(0.1)
        gc.collect()
        stores = sum(thread.name == "store" for thread in threading.enumerate())
        return stores, _descriptors(), _mappings(), len(alarms)

    for _ in range(3):
        play()
    before = left()
    for _ in range(20):
        play()
    assert left() == before
    assert before[0] == before[3] == 0
    assert not bench.host.running
    assert not bench.host._saved
    bench.close()


def _descriptors() -> int:
    gc.collect()
    path = Path("/proc/self/fd")
    return sum(1 for _ in path.iterdir()) if path.exists() else 0


def _mappings() -> int:
    path = Path("/proc/self/maps")
    return path.read_text().count("memfd:terrain") if path.exists() else 0


def test_a_world_whose_ticks_take_too_long_is_reported_by_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(tmp_path, PLAIN)
    for name in ("slow", "quick"):
        bench.worlds.create("plain", name=name)
    ticker = bench.host.running["slow"].ticker
    ends = iter([0.05, 1.01])
    ticker._clock = lambda: next(ends)
    with caplog.at_level(logging.WARNING):
        ticker._run(0.0, 0.0)  # takes 50 ms
        ticker._run(1.0, 1.0)  # takes 10 ms
        bench.host.look_after()
        bench.host.look_after()
    (record,) = caplog.records
    assert record.getMessage().startswith("the world slow: 1 ticks in a second took longer")
    assert bench.host.running["slow"].figures()["ticks_overrun"] == 1
    bench.close()
