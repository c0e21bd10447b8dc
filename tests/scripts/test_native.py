"""The sources compiled by mypyc behave like the sources themselves."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

import pytest

from scripts.native_build import app as native

ROOT = Path(__file__).parents[2]
COMPILES = (shutil.which("cc") or shutil.which("gcc")) and Path(sysconfig.get_path("include"), "Python.h").exists()

pytestmark = [
    pytest.mark.slow,
    pytest.mark.longest,
    pytest.mark.skipif(not COMPILES, reason="there is no C compiler, or none of Python's headers"),
]


def test_a_match_comes_to_the_same_figures(tmp_path: Path) -> None:
    native.build(tmp_path / "copy", optimise=0)

    def run(root: Path, *arguments: str) -> str:
        done = subprocess.run(
            (sys.executable, *arguments), cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(root)}, text=True,
            capture_output=True, check=True,
        )  # fmt: skip
        return done.stdout

    def figures(root: Path) -> dict[str, Any]:
        told = tmp_path / "told.json"
        presets = ("--preset", "wifi", "--preset", "outage")
        match = (*presets, "--clients", "3", "--minutes", "0.5", "--seed", "3", "--no-league")
        run(root, str(root / "scripts" / "netlab.py"), *match, "--json", str(told))
        found: dict[str, Any] = json.loads(told.read_text("utf-8"))["presets"]
        for preset in ("wifi", "outage"):
            assert found[preset].pop("simulated_s_per_cpu_s") > 0
        assert found["wifi"]["late_inputs_share"] > 0
        return found

    modules = [module.removesuffix(".py").replace("/", ".") for module in native.MODULES]
    places = f"import importlib; print([importlib.import_module(each).__file__ for each in {modules}])"
    compiled = run(tmp_path / "copy", "-P", "-c", places)
    assert compiled.count(f"'{tmp_path / 'copy'}") == len(modules)
    assert ".py'" not in compiled
    assert figures(tmp_path / "copy") == figures(ROOT)
