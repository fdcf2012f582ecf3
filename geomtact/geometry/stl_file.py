"""STL, in binary or as text: its triangles, as many as are complete."""

from __future__ import annotations

import re

import numpy as np

from geomtact.errors import MeshError
from geomtact.geometry.polygons import Polygons, edge_table
from geomtact.geometry.text_numbers import number, single_bytes
from geomtact.se3 import Array

_HEAD, _EACH = 84, 50  # bytes of the header with the count, and of each triangle
_SOLID = re.compile(rb"^[ \t]*(end[ \t]*)?solid\b.*$", re.MULTILINE)  # its first line, and its last


def read_stl(data: bytes) -> Polygons:
    """The triangles of an STL file, of all its solids together.

    What begins with "solid" is text, unless it is as long as a binary file of its count or holds zero bytes.

    Raises
    ------
    MeshError
        A file that is neither, or cut short, or that holds another number of triangles than it says, where these do not
        close a surface.
    """
    binary = len(data) >= _HEAD and len(data) == _HEAD + _EACH * int.from_bytes(data[80:_HEAD], "little")
    if binary:
        return _of_binary(data)
    text = single_bytes(data).lstrip().rstrip(b"\0")
    if text[:5].lower() == b"solid" and b"\0" not in text:
        return _of_text(text)
    if len(data) < _HEAD or b"\0" not in data[:_HEAD]:  # a count of less than 2^24 holds a zero byte
        raise MeshError("is neither STL text nor STL in binary; export the mesh again")
    return _of_binary(data)


def _of_binary(data: bytes) -> Polygons:
    stated, there = int.from_bytes(data[80:_HEAD], "little"), (len(data) - _HEAD) // _EACH
    layout = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.frombuffer(data, layout, there, _HEAD)["corners"].astype(float)
    beyond = len(data) - _HEAD - _EACH * stated
    if beyond < 0:
        if there and beyond % _EACH == 0 and _is_closed(corners):
            return _polygons(
                corners,
                f"says that it holds {stated:,} triangles; the {there:,} that are there close a surface and are read",
            )
        raise MeshError(
            f"is cut short: expected {_HEAD + _EACH * stated:,} bytes for the triangles that it says it holds, "
            f"found {len(data):,}; copy or export it again"
        )
    if beyond == 0:
        return _polygons(corners)
    more = corners[stated:]
    padding = bool((more == more[:, :1]).all())  # no bytes of a whole triangle, or triangles of no extent
    short, whole = stated > 0 and (padding or _is_closed(corners[:stated])), not padding and _is_closed(corners)
    if short and not whole:
        return _polygons(corners[:stated], f"{beyond:,} bytes after the last triangle are passed over")
    if not short and (whole or (stated == 0 and beyond % _EACH == 0)):
        return _polygons(corners, f"says that it holds {stated:,} triangles; all {there:,} that are there are read")
    raise MeshError(f"says that it holds {stated:,} triangles, but is long enough for {there:,}; export the mesh again")


def _of_text(text: bytes) -> Polygons:
    text = text.lower() if b"\n" in text else text.lower().replace(b"\r", b"\n")
    solids = [match[1] is None for match in _SOLID.finditer(text)]
    text = _SOLID.sub(b"", text)  # a name may hold any word
    whole = text.count(b"endfacet")
    facets = text.count(b"facet") - whole
    if facets != whole:
        raise MeshError(f"is cut short: {facets - whole} of {facets} facets are not ended; copy or export it again")
    try:
        found = np.array([number(x) for part in text.split(b"vertex")[1:] for x in part.split(None, 3)[:3]])
        found = found.reshape(-1, 3)
    except ValueError:
        raise MeshError("holds vertices that are not three numbers; export the mesh again") from None
    if len(found) != 3 * facets:
        raise MeshError(f"expected three corners in each of {facets} facets, found {len(found)}; export the mesh again")
    corners = found.reshape(-1, 3, 3)
    if 2 * sum(solids) <= len(solids):  # each that begins ends
        return _polygons(corners)
    if facets and _is_closed(corners):
        return _polygons(corners, "does not end with endsolid; its facets close a surface and are read")
    raise MeshError(f"is cut short: endsolid is missing after {facets} facets; copy or export it again")


def _polygons(corners: Array, *warnings: str) -> Polygons:
    n = len(corners)
    return Polygons(corners.reshape(-1, 3), np.arange(3 * n), np.full(n, 3), warnings)


def _is_closed(corners: Array) -> bool:
    """Whether triangles (n, 3, 3) meet others at every edge, an even number of them."""
    if not len(corners) or not np.isfinite(corners).all():
        return False
    _, vertex = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return bool((edge_table(vertex.reshape(-1, 3))[3] % 2 == 0).all())
