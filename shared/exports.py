"""The functions of the kernel sources that Python calls, and the kinds of their arguments.

Both the prebuilt libraries (`scripts/kernels`) and the entry points that Numba compiles are made from this table.
"""

from types import ModuleType

from shared.layout import Arrays

WORLD, NUMBER, TRUTH = "w", "n", "?"
"""Kinds of arguments: the `Arrays` of a world, a whole number, and a truth value."""
ARRAYS = {"q": ("int64", 8), "i": ("int32", 4), "u": ("uint32", 4), "b": ("uint8", 1)}
"""Kinds of flat arrays: the type of their elements, and its size in bytes. A capital letter: it is written to."""

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
        "read_turns": "bbQ",
        "read_rows": "bqqqnQ",
        "alike": "qnqnnnq",
        "news": "qqqnnQQQB",
        "muster": "qiQBn",
        "recall": "qqQQn",
    },
}
"""Each function by its source: one letter for each argument. All return nothing, a truth value or a whole number that
fits into 32 bits."""

FIELDS = {name: {"solid": "u", "heads": "i"}.get(name, "q") for name in Arrays._fields}
"""The kind of each array of a world."""


def functions() -> dict[str, str]:
    """The argument kinds of all functions, by name."""
    return {name: kinds for of_source in EXPORTS.values() for name, kinds in of_source.items()}


def of(source: ModuleType) -> dict[str, str]:
    """Returns the functions of one source, with the kinds of their arguments."""
    return EXPORTS[source.__name__.rpartition(".")[2]]


def words_of(kinds: str) -> int:
    """The number of int64 words that hold the arguments of a call: two for an array (address, length), else one."""
    return sum(1 if kind in (WORLD, NUMBER, TRUTH) else 2 for kind in kinds)


def item(kind: str) -> tuple[str, int]:
    """The element type of an array of a kind, and its size in bytes."""
    return ARRAYS[kind.lower()]
