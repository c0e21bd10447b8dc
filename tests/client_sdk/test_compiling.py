"""A client never waits for a compiler: it plays with the plain kernel until the chosen one is ready."""

import subprocess

import pytest

from client_sdk.compiling import Compiler
from client_sdk.core import Core
from shared import kernels
from shared.kernels import NUMBA, PLAIN, PREBUILT, Kernel
from shared.scene import load_scene
from sovereign_netcode.playtest import Link, Match, wander

pytestmark = pytest.mark.skipif(not kernels.available(), reason="there is no compiled kernel")


class Slow:
    """Kernels of which Numba's is chosen. It is ready once it has been `compiled`."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.compiled = False
        self.waited = 0
        """Calls that would have waited for the compiler."""
        self._get = kernels.get
        patch.setattr(kernels, "ready", lambda: self.compiled)
        patch.setattr(kernels, "get", self.get)

    def get(self, compiled: bool | None = None) -> Kernel:
        """Returns the functions of a ready kernel as those of Numba."""
        self.waited += compiled is not False and not self.compiled
        kernel = self._get(compiled)
        return Kernel(**(vars(kernel) | {"form": NUMBA if kernel.compiled else PLAIN}))


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Slow:
    return Slow(monkeypatch)


@pytest.mark.parametrize("away", [False, True], ids=["playing", "on the way back"])
def test_a_client_joins_and_plays_uncompiled_and_then_goes_on_compiled(slow: Slow, away: bool) -> None:
    match = Match(load_scene("flat"), seed=3)
    waited = slow.waited  # the server's world may be compiled
    core = Core("Ann", patience_s=10.0)
    player = match.join(wander, Link(0.05), core)
    match.run(5)
    prediction = core.prediction
    assert prediction is not None
    assert (core.state, core.stats.kernel) == ("playing", "plain for now")
    assert not prediction.predicted.compiled
    assert not prediction.confirmed.compiled
    if away:
        player.disconnect()
        match.run(0.2)
        assert core.state == "reconnecting"
    assert slow.waited == waited
    slow.compiled = True
    match.run(5)
    prediction = core.prediction
    assert prediction is not None
    assert prediction.predicted.compiled
    assert prediction.confirmed.compiled
    assert (core.state, core.stats.kernel) == ("playing", NUMBA)
    assert core.stats.divergences == 0
    assert core.stats.corrections == 0 or away
    assert core.stats.snapshots > 200


def test_a_client_with_a_given_kernel_has_it_at_once(slow: Slow) -> None:
    match = Match(load_scene("flat"), seed=3)
    for compiled in (True, False):
        core = Core(compiled=compiled)
        match.join(wander, core=core)
        match.run(1)
        assert core.prediction is not None
        assert core.prediction.predicted.compiled is compiled
        assert core.stats.kernel == (NUMBA if compiled else PLAIN)


def test_nothing_is_started_where_nothing_has_to_be_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", None)
    for form in (PLAIN, *([] if kernels.trouble() else [PREBUILT])):
        monkeypatch.setenv(kernels.VARIABLE, form)
        compiler = Compiler()
        compiler.begin()
        compiler.end()


def test_a_compiler_that_fails_leaves_the_client_with_plain_python(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(kernels.VARIABLE, NUMBA)
    monkeypatch.setattr(kernels, "ready", lambda: False)
    for program, said in (("raise SystemExit(3)", "exit code 3"), (None, "the compiler could not be started")):
        if program is None:
            monkeypatch.setattr("sys.executable", "/nowhere/python")
        compiler = Compiler(program or "")
        compiler.begin()
        compiler.wait()
        compiler.end()
        assert said in caplog.messages[-1]


def test_the_end_of_a_program_ends_its_compiler(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(kernels.VARIABLE, NUMBA)
    monkeypatch.setattr(kernels, "ready", lambda: False)
    compiler = Compiler("import time; time.sleep(600)")
    compiler.begin()
    compiler.end()
    assert caplog.messages == []
