"""Compiles the kernel with Numba in the background, while a client already plays with the plain kernel.

This happens only if `shared.kernels` chooses Numba, that is, where there is no prebuilt kernel. Another process
compiles into Numba's cache on disk, so that no frame of the program is delayed. Then a thread loads the result from the
cache. If this fails, for example in a frozen program, the client goes on with the plain kernel.
"""

import atexit
import logging
import os
import subprocess
import sys
import threading

from shared import kernels

PROGRAM = f"from {kernels.__name__.rpartition('.')[0]} import kernels; kernels.get()"
"""Python code that the other process runs."""
NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # exists on Windows only
LOADING_S = 10.0
"""Longest time that the end of the program waits for the thread, in seconds."""

logger = logging.getLogger(__name__)


class Compiler:
    """A background compilation of the chosen kernel, which happens once per program.

    Args:
        program: Python code that the other process runs.
    """

    def __init__(self, program: str = PROGRAM) -> None:
        self._program = program
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._over = False

    def begin(self) -> None:
        """Starts the compilation and returns at once. Does nothing if nothing has to be compiled.

        Raises:
            ValueError: the setting SOVEREIGN_KERNEL has an unknown value.
        """
        with self._lock:
            if self._thread is None and not kernels.ready():
                self._thread = threading.Thread(target=self._run, name="compiling the kernel", daemon=True)
                atexit.register(self.end)
                self._thread.start()

    def wait(self) -> None:
        """Waits until the kernel is ready, or has failed to compile."""
        if self._thread is not None:
            self._thread.join()

    def end(self) -> None:
        """Ends the process and the thread; called at the end of the program."""
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
        """Compiles the kernel into the cache, in another process. Returns whether that succeeded."""
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
                logger.warning("the physics stays in plain Python: the compiler could not be started (%s)", error)
                return False
        status = self._process.wait()
        if status and not self._over:
            logger.warning("the physics stays in plain Python: Numba could not compile it (exit code %d)", status)
        return status == 0


COMPILER = Compiler()
"""The background compilation that all clients of the program share."""
