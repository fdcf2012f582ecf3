"""The numbers and comments of mesh files that are text, as the formats have them and not as Python would read them."""

from __future__ import annotations

import re

from geomtact.errors import MeshError

_UTF16 = re.compile(rb"\xff\xfe|\xfe\xff|(?:[\t\n\r -~]\0){4}|(?:\0[\t\n\r -~]){4}")
_COMMENT = re.compile(rb"(?:^|\s)#.*", re.DOTALL)
_NOT_FINITE = re.compile(rb"[+-]?\d\.#")  # 1.#INF and 1.#QNAN of Microsoft's libraries until 2013


def single_bytes(data: bytes) -> bytes:
    """The text of a file without its byte order mark.

    Raises
    ------
    MeshError
        It is UTF-16.
    """
    if _UTF16.match(data):
        raise MeshError("is UTF-16 text, expected ASCII or UTF-8; save or export it as that")
    return data.removeprefix(b"\xef\xbb\xbf")


def without_comment(line: bytes) -> bytes:
    """A line up to its comment, which begins where a word does: the mark within a word is none."""
    return _COMMENT.sub(b"", line, count=1) if b"#" in line else line


def number(word: bytes) -> float:
    """What a word means, NaN for Microsoft's spellings of what is not finite.

    Raises
    ------
    ValueError
        It is no number; Python's underscores between digits make none.
    """
    if b"_" in word:
        raise ValueError(word)
    return float("nan") if _NOT_FINITE.match(word) else float(word)


def whole(word: bytes) -> int:
    """As :func:`number`, for whole numbers."""
    if b"_" in word:
        raise ValueError(word)
    return int(word)
