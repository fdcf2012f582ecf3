"""Text files read with their faults named, and files written whole or not at all."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from pathlib import Path


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, with a byte order mark or without; OSError, or ValueError where it is saved otherwise."""
    try:
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError("not saved as UTF-8") from None


def write_text(path: Path, text: str) -> None:
    """:func:`printable` ``text`` as UTF-8, whole or not at all."""
    write_whole(path, lambda temporary: temporary.write_text(printable(text), "utf-8"))


def printable(text: str) -> str:
    """``text`` that UTF-8 holds: bytes of a file name that are no UTF-8 are written by their number."""
    return text.encode("utf-8", "backslashreplace").decode()


def write_bytes(path: Path, data: bytes) -> None:
    """``data``, whole or not at all."""
    write_whole(path, lambda temporary: temporary.write_bytes(data))


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` make a file under a temporary name beside ``path``, then rename it: a killed run leaves no half file."""
    temporary = path.with_name(f".{secrets.token_hex(3)}-{path.name}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
