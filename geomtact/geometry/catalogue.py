"""The bundled objects: ``meshes/catalogue.toml`` lists each one's file, unit, hash, licence and symmetry."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from geomtact.geometry.symmetry import Symmetry, group_of
from geomtact.se3 import Array


@dataclass(frozen=True)
class Entry:
    """One bundled object.

    Attributes
    ----------
    file : the mesh file
    unit : its unit
    sha256 : hash of the file's bytes
    licence : of the mesh
    description : one line
    symmetry : rotation symmetry of the object (see geometry/symmetry.py)
    """

    file: Path
    unit: str
    sha256: str
    licence: str
    description: str
    symmetry: Symmetry


def meshes_folder() -> Path | None:
    """Folder of the bundled objects: ``meshes/`` of the source checkout, or the package's data when installed."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package.parent / "meshes", package.parent / "geomtact_meshes", package / "geomtact_meshes"):
        if (folder / "catalogue.toml").is_file():
            return folder
    return None


@cache
def catalogue() -> dict[str, Entry]:
    """The bundled objects by name, sorted; empty where they are not installed."""
    folder = meshes_folder()
    if folder is None:
        return {}
    tables = tomllib.loads((folder / "catalogue.toml").read_text("utf-8"))
    return {name: _entry(folder, tables[name]) for name in sorted(tables)}


def _entry(folder: Path, table: dict) -> Entry:
    found = table["symmetry"]
    centre = 1e-3 * np.asarray(found["centre_mm"], float)
    turns = [2 * np.pi / turn["order"] * _unit(turn["axis"]) for turn in found["turns"]]
    axis = _unit(found["axis"]) if "axis" in found else None
    return Entry(
        file=folder / table["file"],
        unit=table["unit"],
        sha256=table["sha256"],
        licence=table["licence"],
        description=table["description"],
        symmetry=Symmetry(found["kind"], group_of(turns, centre), axis, centre),
    )


def _unit(direction: list[float]) -> Array:
    return np.asarray(direction, float) / np.linalg.norm(direction)
