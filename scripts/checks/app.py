"""Runs every check and every kind of test.

scripts/test          the checks, and the tests in their short form: some minutes
scripts/test --all    the checks, and all tests, also in their long form
scripts/test --long   only the long forms, and the property tests with all their examples
scripts/test ARGS     pytest alone with these arguments
"""

import os
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor

from scripts.browser_build import tools
from scripts.environment import PYTHON, ROOT, Step, nice, run

STUBS = ("hatch_build.py",)
"""The command that writes the type stubs from the modules as they are now. The checks read them."""
CHECKS = {
    "ruff format": ("-m", "ruff", "format", "--check"),
    "ruff check": ("-m", "ruff", "check"),
    "language": ("-m", "scripts.checks.language"),
    "import-linter": ("-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-logo"),
}
LONG = "(slow or hypothesis) and not contained"
"""Markers of the tests that are longer in a long run."""
BALANCED = ("--dist", "worksteal")
"""Options of pytest with which an idle worker takes tests from another."""


def main(arguments: list[str]) -> int:
    """Runs what the arguments of `scripts/test` ask for. Returns the exit code."""
    # Without files of bytecode each worker and each process that a test starts compiles all sources again.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    if arguments in (["--long"], ["--all"]):
        run("browsers", "-m", "scripts.browser_build.app", "--tests")  # without it, tests in browsers are skipped
        os.environ["PATH"] = tools.path()
    if arguments == ["--long"]:
        steps = [*compiled(), *together(LONG, "long"), alone(LONG, "long")]
    elif arguments == ["--all"]:
        steps = everything("not contained", "long")
    elif arguments:
        return run("pytest", "-m", "pytest", *arguments).status
    else:
        steps = everything("not slow", "short")
    print()
    for step in steps:
        print(f"{step.title:<15} {'failed' if step.status else 'ok':<6} {step.seconds:6.1f} s")
    return int(any(step.status for step in steps))


def everything(markers: str, profile: str) -> list[Step]:
    """Runs all checks of the sources and the tests with these markers.

    mypy needs most of a minute of one processor, beside the other checks and the tests.
    """
    steps = [run("type stubs", *STUBS)]
    with ThreadPoolExecutor(2) as pool:
        types = pool.submit(captured, "mypy", 5 if profile == "short" else 15, "-m", "mypy")
        ready = pool.submit(compiled)
        steps += [run(title, *command) for title, command in CHECKS.items()]
        steps += [*ready.result(), *together(markers, profile)]
        steps.append(shown(types.result()))
    return [*steps, alone(markers, profile)]


def captured(title: str, niceness: int, *args: str) -> tuple[Step, str]:
    """Runs the environment's Python beside other work. Returns the output, too."""
    started = time.perf_counter()
    command = (*nice(niceness), str(PYTHON), *args)
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return Step(title, done.returncode, time.perf_counter() - started), done.stdout


def shown(done: tuple[Step, str]) -> Step:
    """Prints the output of a step. Returns the step."""
    step, output = done
    print(f"\n== {step.title}\n{output}", end="", flush=True)
    return step


def compiled() -> list[Step]:
    """Compiles the tests, unless that was done before. Returns the step. The workers report what cannot be collected.

    pytest rewrites all assertions, which takes 10 s of processor time. The workers begin at the same time with the same
    files, so each of them would do it.
    """
    if any((ROOT / "tests").rglob("*-pytest-*.pyc")):
        return []
    started = time.perf_counter()
    command = (str(PYTHON), "-m", "pytest", "--collect-only", "-qqq")
    folders = sorted({str(path.parent) for path in (ROOT / "tests").glob("*/**/test_*.py")})
    halves = [
        subprocess.Popen((*command, *half), cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for half in (folders[::2], folders[1::2])
    ]
    for process in halves:
        process.wait()
    return [Step("compiled tests", 0, time.perf_counter() - started)]


def together(markers: str, profile: str) -> list[Step]:
    """Runs several tests at a time.

    Many short runs wait for a part of their time, so there are twice as many as processors. Of the long ones, only
    those end to end wait, and a busy machine disturbs them. They run beside the others, and come before them wherever
    both want the processor.
    """
    if profile == "short":
        return [run("tests", *pytest(markers, "not alone", profile), "-n", "4", *BALANCED)]
    waiting, others = (pytest(markers, f"{which} and not alone", profile) for which in ("e2e", "not e2e"))
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(captured, "tests end to end", 0, *waiting, *files("e2e"), "-n", "2", *BALANCED)
        return [run("tests", *others, "-n", "2", *BALANCED, niceness=10), shown(beside.result())]


def alone(markers: str, profile: str) -> Step:
    """Runs the tests that measure time, one by one."""
    return run("tests alone", *pytest(markers, "alone", profile), *files("alone"))


def files(marker: str) -> list[str]:
    """Returns the files that have a test with a marker. To collect only them saves 10 s."""
    tests = sorted((ROOT / "tests").rglob("test_*.py"))
    return [str(path) for path in tests if f"mark.{marker}" in path.read_text("utf-8")]


def pytest(markers: str, more: str, profile: str) -> tuple[str, ...]:
    """Returns the arguments that run the tests with all these markers."""
    both = f"{markers} and {more}" if markers else more
    return "-m", "pytest", "--hypothesis-profile", profile, "-m", both
