"""Runs every check and every kind of test.

scripts/test          the checks, and the tests in their short form: some minutes
scripts/test --all    the checks, and all tests in their long form
scripts/test --long   only the tests that are longer than in `scripts/test`, or have more examples
scripts/test ARGS     pytest alone with these arguments
"""

from scripts.environment import Step, run

CHECKS = {
    "type stubs": ("hatch_build.py",),  # written from the modules as they are now; the others read them
    "ruff format": ("-m", "ruff", "format", "--check"),
    "ruff check": ("-m", "ruff", "check"),
    "language": ("-m", "scripts.checks.language"),
    "mypy": ("-m", "mypy"),
    "import-linter": ("-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-logo"),
}


def main(arguments: list[str]) -> int:
    """Runs what the arguments of `scripts/test` ask for. Returns the exit code."""
    if arguments == ["--long"]:
        steps = tests("(slow or hypothesis)", "long")
    elif arguments == ["--all"]:
        steps = [*checks(), *tests("", "long")]
    elif arguments:
        return run("pytest", "-m", "pytest", *arguments).status
    else:
        steps = [*checks(), *tests("not slow", "short")]
    print()
    for step in steps:
        print(f"{step.title:<14} {'failed' if step.status else 'ok':<6} {step.seconds:6.1f} s")
    return int(any(step.status for step in steps))


def checks() -> list[Step]:
    """Runs all checks of the sources."""
    return [run(title, *command) for title, command in CHECKS.items()]


def tests(markers: str, profile: str) -> list[Step]:
    """Runs tests with these markers: two at a time, and then one by one those that measure time."""
    together, alone = (" and ".join(filter(None, (markers, which))) for which in ("not alone", "alone"))
    pytest = ("-m", "pytest", "--hypothesis-profile", profile, "-m")
    return [
        run("tests", *pytest, together, "-n", "2", "--dist", "worksteal"),
        run("tests alone", *pytest, alone),
    ]
