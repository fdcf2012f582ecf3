"""Stanford PLY: its polygons, as text or in binary, and its triangle strips."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from geomtact.errors import MeshError
from geomtact.geometry.polygons import Indices, Polygons
from geomtact.geometry.text_numbers import number, single_bytes
from geomtact.se3 import Array

_NAMES = {
    "i1": "char int8",
    "u1": "uchar uint8",
    "i2": "short int16",
    "u2": "ushort uint16",
    "i4": "int int32",
    "u4": "uint uint32",
    "i8": "int64",
    "u8": "uint64",
    "f4": "float float32",
    "f8": "double float64",
}
_TYPES = {name: kind for kind, names in _NAMES.items() for name in names.split()}
_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q", "f4": "f", "f8": "d"}
_FORMATS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_INDICES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class _Property:
    """A column: its type, and that of the number before each row's values where it is a list."""

    name: str
    type: str
    count: str | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    rows: int
    properties: list[_Property]


def read_ply(data: bytes) -> Polygons:
    """The polygons of a PLY file; whatever else it holds of vertices, faces, edges or materials is passed over.

    Raises
    ------
    MeshError
        A file of another kind, cut short, or without what is due in it.
    """
    data = single_bytes(data)
    form, elements, start = _header(data)
    order = _FORMATS[form]
    if form == "ascii":  # all numbers as doubles: from here on as binary
        try:
            body = np.array([number(word) for word in data[start:].split()]).astype("<f8").tobytes()
        except ValueError:
            raise MeshError("holds words among its numbers; export the mesh again") from None
    else:
        body = data[start:]
    vertices, polygons, at = np.zeros((0, 3)), [], 0
    for element in elements:
        names = [each.name for each in element.properties]
        given = [name for name in _INDICES if name in names]
        columns, at = _columns(element, body, at, order)
        if element.name == "vertex":
            if not {"x", "y", "z"} <= set(names):
                raise MeshError(f"expected vertices with x, y and z, got {', '.join(names)}; export the mesh again")
            vertices = np.stack([np.asarray(columns[name][0], float) for name in "xyz"], axis=1)
        elif element.name in ("face", "tristrips") and element.rows:
            if not given:
                raise MeshError(f"expected faces with vertex_indices, got {', '.join(names)}; export the mesh again")
            values, sizes = columns[given[0]]
            corners = np.asarray(values, np.int64)
            polygons.append((corners, sizes) if element.name == "face" else _strips(corners, sizes))
    if at < len(body) and form == "ascii":
        raise MeshError("holds more numbers than its header says; export the mesh again")
    warnings = (f"{len(body) - at} bytes after the last row are passed over",) if at < len(body) else ()
    corners = np.concatenate([np.zeros(0, np.int64), *(corners for corners, _ in polygons)])
    sizes = np.concatenate([np.zeros(0, np.int64), *(sizes for _, sizes in polygons)])
    return Polygons(vertices, corners, sizes, warnings)


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Format, elements, and where the numbers begin."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise MeshError("expected a header from ply to end_header; export the mesh again")
    newline = b"\r\n" if data[3:5] == b"\r\n" else data[3:4]
    start = end + len(b"end_header")
    start += len(newline) if data[start : start + len(newline)] == newline else 1
    form, elements = "", []
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        try:
            match words:
                case ["format", name, *_]:
                    form = name
                case ["element", name, rows] if rows.isdecimal():
                    elements.append(_Element(name, int(rows), []))
                case ["property", "list", count, kind, name]:
                    elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[count]))
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, _TYPES[kind]))
                case ["element" | "property", *_]:
                    raise ValueError
        except (KeyError, IndexError, ValueError):
            raise MeshError(f"its header cannot be read at {line.strip()[:60]!r}; export the mesh again") from None
    if form not in _FORMATS:
        raise MeshError(f"expected a format of {', '.join(_FORMATS)}, got {form!r}; export the mesh again")
    if form == "ascii":
        elements = [
            _Element(e.name, e.rows, [_Property(p.name, "f8", p.count and "f8") for p in e.properties])
            for e in elements
        ]
    return form, elements, start


def _columns(element: _Element, body: bytes, at: int, order: str) -> tuple[dict[str, tuple[Array, Indices]], int]:
    """Values and numbers of values in each row, by property, of an element that begins at byte ``at``; and where it ends."""
    lists = [each for each in element.properties if each.count]
    columns: dict[str, tuple[Array, Indices]] = {}
    if not element.rows:
        return {each.name: (np.zeros(0), np.zeros(0, np.int64)) for each in element.properties}, at
    sizes = _row(element, body, at, order)[1]
    alike = np.dtype(
        [field for each, n in zip(element.properties, sizes, strict=True) for field in _fields(each, n, order)]
    )
    if at + element.rows * alike.itemsize <= len(body):
        table = np.frombuffer(body, alike, element.rows, at)
        if all((table["n " + each.name] == table["n " + each.name][0]).all() for each in lists):
            for each, n in zip(element.properties, sizes, strict=True):
                columns[each.name] = table[each.name].reshape(-1), np.full(element.rows, n)
            return columns, at + element.rows * alike.itemsize
    parts: list[tuple[list, list[int]]] = [([], []) for _ in element.properties]
    for _ in range(element.rows):
        values, sizes, at = _row(element, body, at, order)
        for (some, counts), value, n in zip(parts, values, sizes, strict=True):
            some += value
            counts.append(n)
    for each, (some, counts) in zip(element.properties, parts, strict=True):
        columns[each.name] = np.array(some), np.array(counts, np.int64)
    return columns, at


def _fields(each: _Property, n: int, order: str) -> list[tuple]:
    if each.count is None:
        return [(each.name, order + each.type)]
    return [("n " + each.name, order + each.count), (each.name, order + each.type, (n,))]


def _row(element: _Element, body: bytes, at: int, order: str) -> tuple[list[tuple], list[int], int]:
    """Values of each property of the row at byte ``at``, how many they are, and where the next row begins."""
    values, sizes = [], []
    try:
        for each in element.properties:
            n = 1
            if each.count is not None:
                n = int(struct.unpack_from(order + _CODES[each.count], body, at)[0])
                at += int(each.count[1])
            code = f"{order}{n}{_CODES[each.type]}"
            values.append(struct.unpack_from(code, body, at))
            sizes.append(n)
            at += n * int(each.type[1])
    except (struct.error, ValueError, OverflowError):
        raise MeshError(
            f"is cut short: expected {element.rows} rows of {element.name}, found fewer; copy or export it again"
        ) from None
    return values, sizes, at


def _strips(corners: Indices, sizes: Indices) -> tuple[Indices, Indices]:
    """Corners and sizes of the triangles of strips, whose ends are marked by -1; every other triangle is wound the other way."""
    strip = np.repeat(np.arange(len(sizes)), sizes) + np.cumsum(corners < 0)
    corners, strip = corners[corners >= 0], strip[corners >= 0]
    _, begin, number = np.unique(strip, return_index=True, return_inverse=True)
    odd = (np.arange(len(corners)) - begin[number.ravel()]) % 2 == 1
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    faces = np.where(odd[:-2, None], faces[:, [1, 0, 2]], faces)[strip[:-2] == strip[2:]]
    return faces.reshape(-1), np.full(len(faces), 3)
