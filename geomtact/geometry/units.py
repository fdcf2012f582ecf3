"""The units of mesh files: which there are, and which one a file states itself."""

from __future__ import annotations

import re
from pathlib import Path

from geomtact.errors import MeshError
from geomtact.geometry.off_file import split_keyword
from geomtact.geometry.text_numbers import without_comment

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
METRE_FORMATS = (".glb", ".gltf")
_COMMENTED_FORMATS = (".ply", ".obj", ".off")
_LONGEST_HEAD = 2**16  # bytes
_SKETCHUP = {"millimeters": "mm", "centimeters": "cm", "meters": "m", "inches": "inch"}


def unit_comment(unit: str) -> str:
    """The comment by which a mesh file states its unit, without the mark of a comment."""
    return f"unit: {unit}"


def stated_unit(path: Path) -> str | None:
    """The unit that a mesh file states: metres for glTF, else by a comment before the first vertex, in its first 64 KiB.

    Only a whole line counts: ``comment unit: mm`` in PLY, ``# unit: mm`` in OBJ and OFF, and SketchUp's
    ``# File units = millimeters`` in OBJ.

    Raises
    ------
    MeshError
        The comments contradict each other, or SketchUp's unit is none of ``UNITS``.
    """
    if path.suffix.lower() in METRE_FORMATS:
        return "m"
    stated = set()
    for line in _comments(path):
        if own := re.fullmatch(rf"unit:? ({'|'.join(UNITS)})", line):
            stated.add(own[1])
        elif (other := re.fullmatch(r"File units = (\w+)", line)) and path.suffix.lower() == ".obj":
            stated.add(_SKETCHUP.get(other[1].lower(), other[1]))
    if len(stated) > 1:
        raise MeshError(f"{path}: its comments state two units, {' and '.join(sorted(stated))}; remove the wrong one")
    unit = next(iter(stated), None)
    if unit is not None and unit not in UNITS:
        raise MeshError(f"{path}: a comment states the unit {unit}; export it in one of {', '.join(UNITS)}")
    return unit


def _comments(path: Path) -> list[str]:
    """The text of each comment line at the head of a file."""
    suffix = path.suffix.lower()
    if suffix not in _COMMENTED_FORMATS:
        return []
    with open(path, "rb") as file:
        lines = [line.strip() for line in file.read(_LONGEST_HEAD).removeprefix(b"\xef\xbb\xbf").splitlines()]
    if suffix == ".ply":
        head, mark = lines[: lines.index(b"end_header")] if b"end_header" in lines else [], b"comment "
    else:
        head, mark = lines[: (_first_of_obj if suffix == ".obj" else _first_of_off)(lines)], b"#"
    return [line.removeprefix(mark).strip().decode("latin-1") for line in head if line.startswith(mark)]


def _first_of_obj(lines: list[bytes]) -> int:
    """Number of lines before the first vertex."""
    return next((k for k, line in enumerate(lines) if line.split()[:1] == [b"v"]), len(lines))


def _first_of_off(lines: list[bytes]) -> int:
    """Number of lines before the first vertex, which follows the keyword, if there is one, and two counts or three."""
    counts, begun = 0, False
    for k, line in enumerate(lines):
        words = without_comment(line).split()
        if words and not begun:
            words, begun = _behind_keyword(words), True
        counts += len(words)
        if counts > 3:
            return k
    return len(lines)


def _behind_keyword(words: list[bytes]) -> list[bytes]:
    try:
        return split_keyword(words)[1]
    except MeshError:  # which reading the file reports
        return words
