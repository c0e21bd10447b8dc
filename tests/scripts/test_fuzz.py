"""The fuzzer: a short run, the same run again from its seed, and a fault that it finds."""

from pathlib import Path

import pytest

from scripts.fuzzing import app as fuzz
from scripts.fuzzing import targets
from tests.lengths import contained, long

INPUTS = {"client": 20_000, "server": 10_000, "value": 10_000, "edit": 10_000, "session": 8_000, "settings": 150}
SEED = 7


@pytest.mark.parametrize("share", [*contained(0.05), *long(1.0)])
@pytest.mark.parametrize("name", sorted(targets.TARGETS))
def test_a_short_run_from_the_corpus_that_is_kept(name: str, share: float) -> None:
    found = fuzz.fuzz(name, round(share * INPUTS[name]), SEED)
    assert found["failure"] == ""
    assert found["corpus"] > 0
    assert found["outcomes"] > 1


def test_a_run_is_the_same_again_from_its_seed(tmp_path: Path) -> None:
    runs = [fuzz.fuzz("client", 3000, seed, corpus=tmp_path / str(n), keep=True) for n, seed in enumerate((1, 1, 2))]
    kept = [sorted(path.name for path in (tmp_path / str(n)).rglob("*")) for n in range(3)]
    assert kept[0] == kept[1] != kept[2]
    assert runs[0]["outcomes"] == runs[1]["outcomes"]


def test_an_input_that_breaks_a_promise_is_found_and_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fragile(data: bytes) -> str:
        assert b"\xc1" not in data
        return str(len(data) > 10)

    monkeypatch.setitem(targets.TARGETS, "client", (lambda: fragile, (b"abc",), 1))
    found = fuzz.fuzz("client", 5000, SEED, corpus=Path("nowhere"))
    assert "AssertionError" in found["failure"]
    assert "c1" in found["failure"].partition(": ")[2].partition("\n")[0]
    assert found["inputs"] < 5000
