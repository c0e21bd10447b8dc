"""Builds the kernel for every target. `scripts/kernels` runs this module in a process of its own.

    python -m scripts.kernel_build.build OUT [--objects TARGET ...]

LLVM makes an object file for each target from one IR (`scripts.kernel_build.ir`). LLD, from the package `ziglang`,
links it to a library. Both are pinned. The bytes of the result depend only on the sources and on the versions that the
manifest names.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scripts.environment import ROOT

LINKER = ROOT / "build" / "linker"
"""Folder in which `scripts/kernels` installs the linker."""
OBJECT, STUBS, DEFINITION = "kernel.o", "python3.lib", "python3.def"
BUILDING = {"NUMBA_OPT": "0", "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "PYTHONHASHSEED": "0"}
"""Environment variables of a build, which make its result reproducible."""
WASM_FEATURES = "+bulk-memory,+sign-ext,+mutable-globals,+nontrapping-fptoint"
WASM_STACK_BYTES = 64 * 1024


@dataclass(frozen=True)
class Target:
    """A library to build.

    Attributes:
        triple, cpu, features: the machine (`scripts.kernel_build.ir.Machine`).
        link: command lines of the linker's tools, in order; {exports} stands for an `--export=NAME` for each function,
            {init} for the export of the Python module.
        python: whether the library is a Python module; otherwise it exports the functions themselves.
    """

    triple: str
    cpu: str
    link: tuple[str, ...]
    features: str = ""
    python: bool = True


ELF = "ld.lld -shared --strip-all --build-id=none --hash-style=gnu -soname=sovereign_kernel"
MACHO = (
    "cc -target aarch64-macos.11.0 -dynamiclib -nostdlib -Wl,-undefined,dynamic_lookup"
    " -Wl,-install_name,sovereign_kernel -Wl,-x"
)
WASM = "wasm-ld --no-entry --strip-all {exports}"
TARGETS = {
    "linux-x86_64.so": Target("x86_64-unknown-linux-gnu", "x86-64", (ELF,)),
    "linux-arm64.so": Target("aarch64-unknown-linux-gnu", "generic", (f"{ELF} -z max-page-size=65536",)),
    "windows-x86_64.pyd": Target(
        "x86_64-pc-windows-msvc",
        "x86-64",
        (
            f"dlltool -m i386:x86-64 -d {DEFINITION} -l {STUBS}",
            f"lld-link /dll /noentry /nodefaultlib /machine:x64 /Brepro {{init}} {STUBS}",
        ),
    ),
    "macos-arm64.so": Target(
        "arm64-apple-macosx11.0.0",
        "apple-m1",
        (MACHO,),
    ),
    "kernel.wasm": Target(
        "wasm32-unknown-unknown",
        "mvp",
        (f"{WASM} --import-memory --stack-first -z stack-size={WASM_STACK_BYTES} --export=__heap_base",),
        WASM_FEATURES,
        python=False,
    ),
    "kernel-emscripten.so": Target(
        "wasm32-unknown-emscripten",
        "mvp",
        (f"{WASM} --experimental-pic -shared",),
        WASM_FEATURES,
        python=False,
    ),
}


def build(out: Path, targets: Sequence[str] = tuple(TARGETS), *, link: bool = True) -> dict[str, Any]:
    """Builds targets into a folder, with a manifest. Returns the manifest.

    Args:
        out: the folder.
        targets: their names.
        link: whether to link libraries; otherwise only the manifest is written, with the object files' checksums.
    """
    import llvmlite.binding as llvm

    from scripts.kernel_build import ir, python_module
    from shared import exports, freshness, kernels

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    print("compiling with Numba ...", flush=True)
    sources = ir.numba_sources(ROOT)
    texts = freshness.sources(Path(source.__file__ or "") for source in kernels.SOURCES)
    code_crc = freshness.code_crc(texts)
    python = python_module.module({**exports.functions(), "built_from": exports.NUMBER})
    files: dict[str, dict[str, Any]] = {}
    for name in targets:
        target = TARGETS[name]
        print(f"{name} ...", flush=True)
        machine = ir.Machine(target.triple, target.cpu, target.features)
        more, visible = (python, (python_module.INIT,)) if target.python else ("", ())
        names = exports.functions(server=target.python)
        used = [source for source in sources if source.name in names]
        module, target_machine = ir.linked(used, code_crc, machine, more, visible)
        code = target_machine.emit_object(module)
        files[name] = {"object": _sha256(code)}
        if link:
            library = _linked(name, code, list(names))
            (out / name).write_bytes(library)
            files[name] |= {"sha256": _sha256(library), "bytes": len(library)}
    manifest = {
        "text_crc": freshness.text_crc(texts),
        "code_crc": code_crc,
        "constants_crc": kernels.constants_crc(),
        "made_with": made_with(),
        "files": files,
    }
    (out / kernels.MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
    return manifest


def made_with() -> dict[str, str]:
    """Returns the versions on which the bytes of the result depend."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, "numba": version("numba"), "llvmlite": version("llvmlite")}


def _linked(name: str, code: bytes, functions: list[str]) -> bytes:
    """Returns the library that is linked from an object file."""
    from scripts.kernel_build.python_module import INIT, PYTHON

    shown = " ".join(f"--export={each}" for each in (*functions, "built_from"))
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / OBJECT).write_bytes(code)
        (Path(folder) / DEFINITION).write_text("\n".join(("LIBRARY python3.dll", "EXPORTS", *PYTHON, "")))
        *before, last = (line.format(exports=shown, init=f"/export:{INIT}").split() for line in TARGETS[name].link)
        for command in before:
            _zig(folder, *command)
        _zig(folder, *last, OBJECT, *((f"/out:{name}",) if last[0] == "lld-link" else ("-o", name)))
        return (Path(folder) / name).read_bytes()


def _zig(folder: str, *arguments: str) -> None:
    """Runs a tool of the package `ziglang` in a folder."""
    environment = os.environ | {
        "PYTHONPATH": str(LINKER),
        "ZIG_GLOBAL_CACHE_DIR": folder,
        "ZIG_LOCAL_CACHE_DIR": folder,
    }
    command = (sys.executable, "-m", "ziglang", *arguments)
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(arguments)}: {done.stdout}{done.stderr}")


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="an existing folder for the results")
    parser.add_argument(
        "--objects", nargs="+", choices=TARGETS, metavar="TARGET", help="do not link; write only the manifest of these"
    )
    args = parser.parse_args()
    build(args.out, args.objects or tuple(TARGETS), link=not args.objects)


if __name__ == "__main__":
    if any(os.environ.get(name) != value for name, value in BUILDING.items()):
        command = (sys.executable, "-P", "-m", "scripts.kernel_build.build", *sys.argv[1:])
        sys.exit(subprocess.run(command, env=os.environ | BUILDING, check=False).returncode)
    main()
