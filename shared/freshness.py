"""Checksums of the kernel sources, by which a prebuilt kernel is known to be made from them.

Standard library only: the build of the wheel uses it, too.
"""

import io
import tokenize
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

CRC_MASK = (1 << 31) - 1
"""A library gives its checksum as a signed 32-bit number that is not negative."""
SILENT = (tokenize.COMMENT, tokenize.NL, tokenize.ENCODING, tokenize.ENDMARKER)
"""Kinds of tokens that do nothing."""
BEFORE_A_STATEMENT = (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)


def crc(texts: Iterable[str]) -> int:
    """A checksum of texts, 0 to 2^31 - 1."""
    total = 0
    for text in texts:
        total = zlib.crc32(text.encode() + b"\0", total)
    return total & CRC_MASK


def sources(paths: Iterable[Path]) -> list[str]:
    """The texts of source files, as they are in the repository: a wheel has the imports of its package in them.

    Raises:
        OSError: one cannot be read.
    """
    return [path.read_text("utf-8").replace("sovereign_netcode.", "") for path in paths]


def constants(source: ModuleType) -> list[tuple[str, int]]:
    """Returns the whole numbers that a module defines or imports: a compiler builds them into its functions."""
    return sorted((name, value) for name, value in vars(source).items() if isinstance(value, int))


def text_crc(texts: Iterable[str]) -> int:
    """A checksum of all of the sources."""
    return crc(texts)


def code_crc(texts: Iterable[str]) -> int:
    """A checksum of what the sources do: comments, docstrings and blank lines are left out (30 ms)."""
    return crc(part for text in texts for part in _code(text))


def _code(text: str) -> Iterator[str]:
    before, docstring = tokenize.NEWLINE, False
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in SILENT:
            continue
        after_docstring, docstring = docstring, token.type == tokenize.STRING and before in BEFORE_A_STATEMENT
        before = token.type
        if not docstring and not after_docstring:  # after it comes the end of its line
            yield {tokenize.INDENT: "{", tokenize.DEDENT: "}"}.get(token.type, token.string.strip())
