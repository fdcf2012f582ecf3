"""Object File Format (OFF): its polygons."""

from __future__ import annotations

import re

import numpy as np

from geomtact.errors import MeshError
from geomtact.geometry.polygons import Polygons
from geomtact.geometry.text_numbers import number, single_bytes, whole, without_comment

# some writers set the counts right behind the word
_KEYWORD = re.compile(rb"((?:ST|C|N|4|n)*)OFF(.*)|((?:st|c|n|4)*)off(.*)", re.DOTALL)

Rows = list[list[bytes]]


def read_off(data: bytes) -> Polygons:
    """The polygons of an OFF file; normals, colours and texture (NCOFF, STOFF) are passed over.

    A vertex or a face has a line of its own. Where the lines do not fit the counts, the numbers are read in their order,
    if nothing but corners and faces is among them.

    Raises
    ------
    MeshError
        A file of another kind, in binary or of other dimensions, cut short, or a line that is not what is due there.
    """
    lines = [words for line in single_bytes(data).splitlines() if (words := without_comment(line).split())]
    if not lines:
        raise MeshError("holds nothing; export the mesh again")
    prefix, first = split_keyword(lines[0])
    if b"4" in prefix or b"n" in prefix:
        raise MeshError("holds vertices of another number of coordinates than three (4OFF or nOFF); export it as OFF")
    if b"BINARY" in first:
        raise MeshError("is an OFF file in binary, which is not read; export it as text, or as PLY")
    rows = [first, *lines[1:]] if first else lines[1:]
    try:
        return _by_lines(rows)
    except MeshError as error:
        some = _by_order(rows) if not prefix else None
        if some is None:
            raise error
        return some


def split_keyword(words: list[bytes]) -> tuple[bytes, list[bytes]]:
    """The prefixes of OFF at the head of a file's first line, and what follows; the word itself may be missing.

    Raises
    ------
    MeshError
        The line begins with another word.
    """
    found = _KEYWORD.fullmatch(words[0])
    if found is None:
        if not words[0].isdigit():
            raise MeshError(f"expected OFF on its first line, got {words[0][:20]!r}; export the mesh again")
        return b"", words
    prefix, behind = (found[1], found[2]) if found[1] is not None else (found[3], found[4])
    return prefix, [word for word in (behind, *words[1:]) if word]


def _by_lines(rows: Rows) -> Polygons:
    """The polygons of a file with a line for the counts, and one for each vertex and face."""
    place = "the numbers of vertices and faces, and perhaps of edges"
    try:
        n, m, *_ = counts = [whole(word) for word in rows[0]]
        if len(counts) > 3 or min(counts) < 0:
            raise ValueError
        if len(rows) < 1 + n + m:
            raise MeshError(
                f"is cut short: expected {n} vertices and {m} faces, a line each, "
                f"found {len(rows) - 1} lines; copy or export it again"
            )
        place = "three numbers"
        vertices = np.array([number(word) for row in rows[1 : 1 + n] for word in row[:3]])
        if len(vertices) != 3 * n or any(len(row) < 3 for row in rows[1 : 1 + n]):
            raise ValueError
        place = "a face's number of corners, and as many whole numbers"
        faces = []
        for row in rows[1 + n : 1 + n + m]:
            corners = [whole(word) for word in row[1 : 1 + whole(row[0])]]
            if len(corners) < whole(row[0]):
                raise ValueError
            faces.append(corners)
    except (ValueError, IndexError):
        raise MeshError(
            f"cannot be read: expected {place} on each line, and some are not; export the mesh again"
        ) from None
    more = len(rows) - 1 - n - m
    warnings = (f"{more} lines after the last face are passed over: the file says it holds {m} faces",) if more else ()
    return Polygons.of(vertices, faces, warnings)


def _by_order(rows: Rows) -> Polygons | None:
    """The polygons of a file of counts, corners and faces alone, however they lie on lines; None if it is no such file."""
    words = [word for row in rows for word in row]
    try:
        n, m, _ = (whole(word) for word in words[:3])
        at = 3 + 3 * n
        vertices = [number(word) for word in words[3:at]]
        faces = []
        for _ in range(m):
            size = whole(words[at])
            faces.append([whole(word) for word in words[at + 1 : at + 1 + size]])
            at += 1 + size
    except (ValueError, IndexError):
        return None
    return Polygons.of(np.array(vertices), faces) if at == len(words) else None
