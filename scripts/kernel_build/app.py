"""Builds the kernels in shared/prebuilt. Run it after every change of a kernel source.

Installs the compiler (Numba) and the linker (from the package ziglang, 100 MB) if they are missing.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from scripts.environment import ROOT
from scripts.kernel_build.build import LINKER

BUILT = ROOT / "shared" / "prebuilt"
PINS = ROOT / "requirements-kernels.txt"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit with 1 if the result differs from the files"
    )
    args = parser.parse_args()
    if not (LINKER / "ziglang").exists():
        print("installing the linker, once ...", flush=True)
        pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps")
        subprocess.run((*pip, "--require-hashes", "--target", str(LINKER), "-r", str(PINS)), check=True)
    with tempfile.TemporaryDirectory() as folder:
        command = (sys.executable, "-P", "-m", "scripts.kernel_build.build", folder)
        if status := subprocess.run(command, cwd=ROOT, check=False).returncode:
            return status
        made = sorted(Path(folder).iterdir())
        changed = [file.name for file in made if not _same(file, BUILT / file.name)]
        for name in changed if not args.check else ():
            shutil.copyfile(Path(folder) / name, BUILT / name)
    print(f"{len(made) - len(changed)} files are unchanged", *(f"{name}: changed" for name in changed), sep="\n")
    return int(args.check and bool(changed))


def _same(one: Path, other: Path) -> bool:
    return other.exists() and one.read_bytes() == other.read_bytes()
