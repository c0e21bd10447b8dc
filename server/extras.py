"""Advice on a library that an optional part needs and that is not installed."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def install(extra: str, root: Path = ROOT) -> str:
    """The command that installs what an extra of `pyproject.toml` names. The project is on no package index.

    Args:
        root: the folder that holds the package `server`.
    """
    if (root / "pyproject.toml").is_file():
        return f"pip install '{root}[{extra}]'"
    return f"pip install 'PATH[{extra}]', where PATH is the repository or the wheel that this was installed from"
