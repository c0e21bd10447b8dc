"""An import of the client loads the standard library and msgpack alone, until it connects."""

import subprocess
import sys
from pathlib import Path

import pytest

from client_sdk import __all__ as names
from client_sdk import events

ROOT = Path(__file__).parent.parent.parent
ALLOWED = {"client_sdk", "shared", "sovereign_netcode", "msgpack"}
FOREIGN = """
import sys
before = set(sys.modules)
{imports}
roots = {{name.partition(".")[0] for name in sys.modules.keys() - before}}
print(*sorted(root for root in roots - set(sys.stdlib_module_names) if "cython" not in root))
print(*sorted(name for name in ("asyncio", "ssl", "socket", "numpy", "websockets") if name in sys.modules))
"""


def after(imports: str) -> list[set[str]]:
    """Returns the foreign packages that imports load, and which of the heavy modules."""
    command = (sys.executable, "-c", FOREIGN.format(imports=imports))
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [set(line.split()) for line in done.stdout.split("\n")[:2]]


def test_the_package_loads_nothing_of_others() -> None:
    foreign, heavy = after("import sovereign_netcode.client_sdk")
    assert foreign <= ALLOWED
    assert heavy == set()


def test_all_names_but_that_of_a_server_within_the_program_load_msgpack_at_most() -> None:
    given = ", ".join(name for name in names if name != "Loopback")
    foreign, heavy = after(f"from sovereign_netcode.client_sdk import {given}")
    assert foreign <= ALLOWED
    assert heavy <= {"asyncio", "ssl", "socket"}, "asyncio itself loads these"


def test_the_polling_client_needs_no_socket_before_it_connects() -> None:
    foreign, heavy = after("from sovereign_netcode.client_sdk import Client, ConnectError, Joined, Left, make_input")
    assert foreign <= ALLOWED
    assert heavy == set()


def test_every_name_is_there_and_an_unknown_one_is_an_error() -> None:
    import client_sdk

    for name in names:
        assert getattr(client_sdk, name) is not None
    assert client_sdk.Joined is events.Joined
    assert set(names) <= set(dir(client_sdk))
    with pytest.raises(AttributeError, match="has no attribute 'Joind'"):
        client_sdk.Joind  # noqa: B018
