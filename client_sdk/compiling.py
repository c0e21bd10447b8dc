"""The chosen kernel, compiled beside a client that plays already.

Only where `shared.kernels` chooses Numba, so where there is no prebuilt kernel. A process of its own compiles, into
Numba's cache on disk, so that no frame is slower for it; then a thread loads what is there. Where that fails, as in a
frozen program, the client goes on with the plain kernel.
"""

import atexit
import logging
import os
import subprocess
import sys
import threading

from shared import kernels

PROGRAM = f"from {kernels.__name__.rpartition('.')[0]} import kernels; kernels.get()"
NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # of Windows alone
LOADING_S = 10.0
"""The end of the program waits for the thread no longer."""

logger = logging.getLogger(__name__)


class Compiler:
    """Gets the chosen kernel ready beside the program, once.

    Args:
        program: what the other process runs.
    """

    def __init__(self, program: str = PROGRAM) -> None:
        self._program = program
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._over = False

    def begin(self) -> None:
        """Returns at once, and does nothing where nothing has to be compiled.

        Raises:
            ValueError: the setting SOVEREIGN_KERNEL is none of its choices.
        """
        with self._lock:
            if self._thread is None and not kernels.ready():
                self._thread = threading.Thread(target=self._run, name="compiling the kernel", daemon=True)
                atexit.register(self.end)
                self._thread.start()

    def wait(self) -> None:
        """Returns as soon as the kernel is there, or cannot be had."""
        if self._thread is not None:
            self._thread.join()

    def end(self) -> None:
        """Leaves nothing running; called at the end of the program."""
        with self._lock:
            self._over = True
            if self._process is not None:
                self._process.terminate()
        if self._thread is not None:
            self._thread.join(LOADING_S)

    def _run(self) -> None:
        if not getattr(sys, "frozen", False) and self._compiled() and not self._over:
            kernels.get()

    def _compiled(self) -> bool:
        """Whether another process has compiled the kernel into the cache."""
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            kernels.VARIABLE: kernels.chosen(),
        }
        command = (sys.executable, "-c", self._program)
        with self._lock:
            if self._over:
                return False
            try:
                self._process = subprocess.Popen(
                    command,
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    creationflags=NO_WINDOW,
                )
            except OSError as error:
                logger.warning("the physics stays in plain Python: no compiler can be started (%s)", error)
                return False
        status = self._process.wait()
        if status and not self._over:
            logger.warning("the physics stays in plain Python: Numba could not compile it (exit code %d)", status)
        return status == 0


COMPILER = Compiler()
