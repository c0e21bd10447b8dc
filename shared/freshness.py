"""Checksums of the kernel sources, which show whether a prebuilt kernel was made from them.

It uses the standard library only, because the build of the wheel uses it, too.
"""

import io
import tokenize
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

CRC_MASK = (1 << 31) - 1
"""Mask of a checksum: a library returns it as a signed 32-bit number, which must not be negative."""
SILENT = (tokenize.COMMENT, tokenize.NL, tokenize.ENCODING, tokenize.ENDMARKER)
"""Kinds of tokens that have no effect on the code."""
BEFORE_A_STATEMENT = (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
"""Kinds of tokens after which a statement begins; a string there is a docstring."""


def crc(texts: Iterable[str]) -> int:
    """Returns a checksum of texts, 0 to 2^31 - 1."""
    total = 0
    for text in texts:
        total = zlib.crc32(text.encode() + b"\0", total)
    return total & CRC_MASK


def sources(paths: Iterable[Path]) -> list[str]:
    """Returns the texts of source files as they are in the repository.

    In a wheel, their imports name the package; this name is removed.

    Raises:
        OSError: a file cannot be read.
    """
    return [path.read_text("utf-8").replace("sovereign_netcode.", "") for path in paths]


def constants(source: ModuleType) -> list[tuple[str, int]]:
    """Returns the whole numbers that a module defines or imports: a compiler builds them into its functions."""
    return sorted((name, value) for name, value in vars(source).items() if isinstance(value, int))


def text_crc(texts: Iterable[str]) -> int:
    """Returns a checksum of the whole sources, with comments and docstrings."""
    return crc(texts)


def code_crc(texts: Iterable[str]) -> int:
    """Returns a checksum of the code of the sources, without comments, docstrings and blank lines (takes 30 ms)."""
    return crc(part for text in texts for part in _code(text))


def _code(text: str) -> Iterator[str]:
    before, docstring = tokenize.NEWLINE, False
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in SILENT:
            continue
        after_docstring, docstring = docstring, token.type == tokenize.STRING and before in BEFORE_A_STATEMENT
        before = token.type
        if not docstring and not after_docstring:  # the token after a docstring is the end of its line
            yield {tokenize.INDENT: "{", tokenize.DEDENT: "}"}.get(token.type, token.string.strip())
