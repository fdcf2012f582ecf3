"""Wavefront OBJ: its polygons, whatever the order of its lines and the style of its indices."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from geomtact.errors import MeshError
from geomtact.geometry.polygons import Polygons
from geomtact.geometry.text_numbers import number, single_bytes, whole, without_comment

_FREE_FORM = (b"curv", b"curv2", b"surf", b"bzp", b"bsp", b"cdc", b"cdp", b"res")  # curves and patches, old ones too


def read_obj(data: bytes) -> Polygons:
    """The polygons of an OBJ file, of all its objects and groups together.

    Indices may be relative: -1 is the vertex given last before the face's own line. A backslash at its end continues any line,
    those of names too, but no comment.

    Raises
    ------
    MeshError
        A line that is not what it begins as, or a surface of free forms alone.
    """
    vertices: list[float] = []
    faces: list[list[int]] = []
    curves: set[str] = set()
    count, line = 0, b""
    try:
        for count, line in _lines(single_bytes(data)):  # noqa: B007 -- the message names it
            words = line.split()
            if not words:
                continue
            kind = words[0]
            if kind == b"v":
                x, y, z = words[1:4]
                vertices += (number(x), number(y), number(z))
            elif kind in (b"f", b"fo"):
                face = [whole(word.partition(b"/")[0]) for word in words[1:]]
                if min(face, default=1) < 1:
                    face = _counted_from_one(face, len(vertices) // 3)
                faces.append(face)
            elif kind in _FREE_FORM:
                curves.add(kind.decode())
            elif kind == b"call":
                raise MeshError("holds only part of the mesh and calls other files; export it as one file")
    except ValueError:
        shown = line.decode("utf-8", "replace").strip()[:60]
        raise MeshError(
            f"line {count} cannot be read: expected v with three numbers, or f with whole numbers from 1 or below 0 that are "
            f"there, got {shown!r}; export the mesh again"
        ) from None
    named = ", ".join(sorted(curves))
    if curves and not faces:
        raise MeshError(f"holds free-form curves or surfaces ({named}), which are not read; export it as polygons")
    warnings = (f"free-form curves or surfaces ({named}) are left out: polygons alone are read",) if curves else ()
    some = Polygons.of(np.array(vertices), faces, warnings)
    return Polygons(some.vertices, some.corners - 1, some.sizes, warnings)


def _lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Each line without its comment, joined with those that continue it, and the number of the last of them."""
    begun = b""
    for count, line in enumerate(data.splitlines(), 1):
        text = without_comment(line)
        if text == line and text.endswith(b"\\"):
            begun += text[:-1] + b" "
            continue
        yield count, begun + text
        begun = b""
    if begun:
        yield count, begun


def _counted_from_one(face: list[int], before: int) -> list[int]:
    """A face's relative indices made absolute ones, with ``before`` vertices given before it."""
    absolute = [index if index > 0 else before + 1 + index for index in face]
    if 0 in face or min(absolute) < 1:
        raise ValueError
    return absolute
