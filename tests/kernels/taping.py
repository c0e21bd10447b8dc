"""A plugin of pytest (`-p tests.kernels.taping`) that records all calls of the compiled kernel to the file TAPE."""

import os
from pathlib import Path

import pytest

from shared import kernels
from tests.kernels.tape import Tape

FILE = Path(os.environ["TAPE"]).open("wb", 1 << 20)  # noqa: SIM115 - until the end of the process
KERNEL = kernels.get(True)
TAPE = Tape(KERNEL, FILE)
kernels._kernels[KERNEL.form] = TAPE.kernel()


def pytest_unconfigure(config: pytest.Config) -> None:
    FILE.close()
    print(f"\ntaped {sum(TAPE.calls.values())} calls")
