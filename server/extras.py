"""The advice to install a library that an optional part of the project needs."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""The folder that holds the package `server`."""


def install(extra: str, root: Path = ROOT) -> str:
    """Returns the pip command that installs the libraries of an extra of `pyproject.toml`.

    The command names a path, because the project is on no package index.

    Args:
        extra: name of the extra.
        root: the folder that holds the package `server`.
    """
    if (root / "pyproject.toml").is_file():
        return f"pip install '{root}[{extra}]'"
    return f"pip install 'PATH[{extra}]', where PATH is the repository or the wheel that this was installed from"
