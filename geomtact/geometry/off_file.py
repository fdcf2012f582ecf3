"""Object File Format (OFF): its polygons."""

from __future__ import annotations

import re

import numpy as np

from geomtact.errors import MeshError
from geomtact.geometry.polygons import Polygons


def read_off(data: bytes) -> Polygons:
    """The polygons of an OFF file; normals, colours and texture (NOFF, COFF, STOFF) are passed over.

    Raises
    ------
    MeshError
        A file of another kind, in binary or of other dimensions, cut short, or a line that is not what is due there.
    """
    lines = [
        words for line in data.removeprefix(b"\xef\xbb\xbf").splitlines() if (words := line.partition(b"#")[0].split())
    ]
    if not lines:
        raise MeshError("holds nothing; export the mesh again")
    # some writers set the counts right behind the word
    head = re.fullmatch(rb"(ST)?C?N?(4?)(n?)OFF(.*)", lines[0][0], re.DOTALL)
    if head is None:
        raise MeshError(f"expected OFF on its first line, got {lines[0][0][:20]!r}; export the mesh again")
    if head[2] or head[3]:
        raise MeshError("holds vertices of another number of coordinates than three (4OFF or nOFF); export it as OFF")
    first = [word for word in (head[4], *lines[0][1:]) if word]
    if b"BINARY" in first:
        raise MeshError("is an OFF file in binary, which is not read; export it as text, or as PLY")
    rows = [first, *lines[1:]] if first else lines[1:]
    place = "the numbers of vertices and faces"
    try:
        n, m = (int(word) for word in rows[0][:2])
        if len(rows) < 1 + n + m:
            raise MeshError(
                f"is cut short: expected {n} vertices and {m} faces, a line each, "
                f"found {len(rows) - 1} lines; copy or export it again"
            )
        place = "three numbers"
        vertices = np.array([float(word) for row in rows[1 : 1 + n] for word in row[:3]])
        if len(vertices) != 3 * n or any(len(row) < 3 for row in rows[1 : 1 + n]):
            raise ValueError
        place = "a face's number of corners, and as many whole numbers"
        faces = []
        for row in rows[1 + n : 1 + n + m]:
            corners = [int(word) for word in row[1 : 1 + int(row[0])]]
            if len(corners) < int(row[0]):
                raise ValueError
            faces.append(corners)
    except (ValueError, IndexError):
        raise MeshError(
            f"cannot be read: expected {place} on each line, and some are not; export the mesh again"
        ) from None
    more = len(rows) - 1 - n - m
    warnings = (f"{more} lines after the last face are passed over: the file says it holds {m} faces",) if more else ()
    return Polygons.of(vertices, faces, warnings)
