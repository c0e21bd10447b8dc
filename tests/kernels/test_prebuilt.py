"""The prebuilt kernels exist for every platform, are built from the current sources, and need only what they should."""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shared import exports, freshness, kernels
from tests.kernels import libraries
from tests.kernels.libraries import Library

ROOT = Path(__file__).parent.parent.parent
PYTHON = {
    "PyBuffer_Release", "PyErr_BadArgument", "PyErr_BadInternalCall", "PyErr_Occurred", "PyLong_AsLongLong",
    "PyLong_FromLongLong", "PyModuleDef_Init", "PyObject_GetBuffer",
}  # fmt: skip
"""Functions of Python that the libraries import; all are in the stable ABI of CPython 3.11."""
INIT = {"PyInit_sovereign_kernel"}
FUNCTIONS = {f"function:{name}" for name in (*exports.functions(server=False), "built_from")}
AGAIN = ("linux-x86_64.so", "kernel.wasm")
"""Targets that a test builds again; each takes some 6 s."""
RUN_SCRIPTS_KERNELS = "run scripts/kernels"


def manifest() -> dict[str, Any]:
    made: dict[str, Any] = json.loads((kernels.LIBRARIES / kernels.MANIFEST).read_text("utf-8"))
    return made


def test_they_are_made_from_the_sources_as_they_are() -> None:
    texts = freshness.sources(Path(source.__file__ or "") for source in kernels.SOURCES)
    made = manifest()
    assert made["text_crc"] == freshness.text_crc(texts), RUN_SCRIPTS_KERNELS
    assert made["code_crc"] == freshness.code_crc(texts), RUN_SCRIPTS_KERNELS
    assert made["constants_crc"] == kernels.constants_crc(), RUN_SCRIPTS_KERNELS


def test_there_is_one_for_every_platform_as_the_manifest_has_it() -> None:
    files = manifest()["files"]
    assert files.keys() == {*kernels.TARGETS.values(), "kernel.wasm", "kernel-emscripten.so"}
    for name, told in files.items():
        data = (kernels.LIBRARIES / name).read_bytes()
        assert (len(data), hashlib.sha256(data).hexdigest()) == (told["bytes"], told["sha256"]), name
        assert len(data) < 120_000
    kept = {path.name for path in kernels.LIBRARIES.iterdir()}
    assert kept == {*files, kernels.MANIFEST}, "nothing else goes into the wheel"


@pytest.mark.parametrize(
    ("name", "read", "found"),
    [
        ("linux-x86_64.so", libraries.elf, Library(62, PYTHON, INIT)),
        ("linux-arm64.so", libraries.elf, Library(183, PYTHON, INIT)),
        ("windows-x86_64.pyd", libraries.pe, Library(0x8664, {f"python3.dll:{name}" for name in PYTHON}, INIT)),
        ("macos-arm64.so", libraries.macho, Library(0x100000C, PYTHON | {"dyld_stub_binder"}, INIT)),
        ("kernel.wasm", libraries.wasm, Library(0, {"memory:memory"}, FUNCTIONS | {"global:__heap_base"})),
        (
            "kernel-emscripten.so",
            libraries.wasm,
            Library(
                0, {"memory:memory", "global:__stack_pointer", "global:__memory_base", "global:__table_base"}, FUNCTIONS
            ),
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_library_needs_python_or_a_memory_and_nothing_else(
    name: str, read: Callable[[bytes], Library], found: Library
) -> None:
    library = read((kernels.LIBRARIES / name).read_bytes())
    assert library._replace(exports=library.exports - {"_mh_dylib_header", "__dso_handle"}) == found


@pytest.mark.slow
@pytest.mark.longest
@pytest.mark.skipif(not kernels.numba_installed(), reason="Numba is not installed")
def test_a_second_build_gives_the_same_bytes(tmp_path: Path) -> None:
    """The bytes are compared before the linker runs. `scripts/kernels --check` includes the linker, which the tests'
    environment lacks."""
    build = (sys.executable, "-m", "scripts.kernel_build.build", str(tmp_path), "--objects", *AGAIN)
    subprocess.run(build, cwd=tmp_path, env=os.environ | {"PYTHONHASHSEED": "7"}, check=True)
    again, made = json.loads((tmp_path / kernels.MANIFEST).read_text("utf-8")), manifest()
    if again["made_with"] != made["made_with"]:
        pytest.skip(f"made with {made['made_with']}, which other versions need not equal")
    assert {name: told["object"] for name, told in again["files"].items()} == {
        name: made["files"][name]["object"] for name in AGAIN
    }
