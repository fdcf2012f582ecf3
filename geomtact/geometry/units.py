"""The units of mesh files: which there are, and which one a file states itself."""

from __future__ import annotations

import re
from pathlib import Path

from geomtact.errors import MeshError

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
METRE_FORMATS = (".glb", ".gltf")
_COMMENTED_FORMATS = (".ply", ".obj", ".off")
_LONGEST_HEAD = 2**16  # bytes
_SKETCHUP = {"millimeters": "mm", "centimeters": "cm", "meters": "m", "inches": "inch"}


def unit_comment(unit: str) -> str:
    """The comment by which a mesh file states its unit, without the mark of a comment."""
    return f"unit: {unit}"


def stated_unit(path: Path) -> str | None:
    """The unit that a mesh file states: metres for glTF, else by a comment before the first vertex.

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
        lines = [line.strip() for line in file.read(_LONGEST_HEAD).decode("latin-1").splitlines()]
    if suffix == ".ply":
        head = lines[: lines.index("end_header")] if "end_header" in lines else []
        return [line.removeprefix("comment ") for line in head if line.startswith("comment ")]
    ends = (k for k, line in enumerate(lines) if line and not line.startswith("#") and not line.endswith("OFF"))
    return [line[1:].strip() for line in lines[: next(ends, len(lines))] if line.startswith("#")]
