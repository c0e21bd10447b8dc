"""The functions of the kernel sources that Python calls, and the kinds of their arguments.

The prebuilt libraries (`scripts/kernels`) and the entry points that Numba compiles are made from this table.
"""

from types import ModuleType

from shared.layout import Arrays

WORLD, NUMBER, TRUTH = "w", "n", "?"
"""Kinds of arguments: the `Arrays` of a world, a whole number, and a truth value."""
ARRAYS = {"q": ("int64", 8), "i": ("int32", 4), "u": ("uint32", 4), "b": ("uint8", 1), "d": ("float64", 8)}
"""Kinds of flat arrays: type and size in bytes of their elements. A capital letter is an array that is written to."""

EXPORTS = {
    "kernel": {
        "step": "wqnn",
        "store": "wqqnn",
        "settle": "wqqnn",
        "follow": "wqnnnn",
        "collect": "qnQ",
        "gather": "wn?nnnnnn",
        "blocks_in": "wnnnnnn",
        "wake_on": "wnnnnnn",
        "wake_in": "wnnnnnn",
        "unlink": "wn",
        "relink_range": "wnn",
    },
    "bulk": {
        "read_turns": "bqQ",
        "read_rows": "bqqqnQ",
        "alike": "qnqnnnq",
        "news": "qqqqnnQQQB",
        "muster": "qiQBn",
        "recall": "qqQQn",
    },
    "traffic": {
        "unmask": "Bq",
        "take_messages": "QDQbqqdBqd",
        "take_inputs": "QQQQQnnnn",
        "confirm_inputs": "Qqnn",
    },
    "delivery": {"write_snapshots": "QDiqqbBQQd"},
    "pacing": {
        "due_rows": "QdQd",
        "measure_rows": "QDqqnd",
    },
    "places": {"mark_near": "qdiB"},
}
"""Argument kinds of each function, by source: one letter per argument. A function returns nothing, a truth value, or a
whole number that fits into 32 bits."""
SERVER_SOURCES = frozenset({"traffic", "delivery", "pacing", "places"})
"""Sources that only servers use. The libraries for browsers do not have their functions."""
SMALL = SERVER_SOURCES | {"news", "muster", "mark_near"}
"""Sources and functions that are compiled to be small rather than fast: they are not the physics."""

FIELDS = {name: {"solid": "u", "heads": "i"}.get(name, "q") for name in Arrays._fields}
"""Kind of each array of a world (`layout.Arrays`), by name."""


def functions(*, server: bool = True) -> dict[str, str]:
    """Returns the argument kinds of all functions, by name.

    Args:
        server: whether to include those of `SERVER_SOURCES`.
    """
    sources = [EXPORTS[name] for name in EXPORTS if server or name not in SERVER_SOURCES]
    return {name: kinds for source in sources for name, kinds in source.items()}


def of(source: ModuleType) -> dict[str, str]:
    """Returns the argument kinds of the functions of one source, by name."""
    return EXPORTS[source.__name__.rpartition(".")[2]]


def words_of(kinds: str) -> int:
    """Returns the number of int64 words for the arguments of a call: two per array (address, length), else one."""
    return sum(1 if kind in (WORLD, NUMBER, TRUTH) else 2 for kind in kinds)


def item(kind: str) -> tuple[str, int]:
    """Returns the element type of an array of a kind, and the size of an element in bytes."""
    return ARRAYS[kind.lower()]
