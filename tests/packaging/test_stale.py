"""No wheel is built with prebuilt kernels of other sources."""

import shutil
from pathlib import Path

import pytest

from hatch_build import StaleError, refuse_stale_kernels
from tests.packaging.bare import ROOT


@pytest.fixture
def root(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "shared", tmp_path / "shared", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def test_fresh_ones_are_taken_and_a_comment_does_not_matter(root: Path) -> None:
    refuse_stale_kernels(root)
    source = root / "shared" / "bulk.py"
    source.write_text(source.read_text("utf-8") + "# a comment\n", "utf-8")
    refuse_stale_kernels(root)


@pytest.mark.parametrize("name", ["kernel.py", "bulk.py", "traffic.py", "delivery.py", "pacing.py", "places.py"])
def test_a_changed_source_is_refused(root: Path, name: str) -> None:
    source = root / "shared" / name
    source.write_text(source.read_text("utf-8") + "MORE = 1\n", "utf-8")
    with pytest.raises(StaleError, match="run scripts/kernels"):
        refuse_stale_kernels(root)


def test_a_changed_library_is_refused(root: Path) -> None:
    library = root / "shared" / "prebuilt" / "kernel.wasm"
    library.write_bytes(library.read_bytes() + b"\0")
    with pytest.raises(StaleError, match=r"kernel\.wasm"):
        refuse_stale_kernels(root)
