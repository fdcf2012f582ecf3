"""An object's entry in a catalogue, which makes its name valid wherever a mesh path is."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from meshprep import Refused
from scipy.spatial.transform import Rotation

from geomtact.files import write_whole
from geomtact.geometry.symmetry import Symmetry, group_of


def add(
    files: Sequence[Path], unit: str, licence: str, description: str, symmetries: Sequence[Symmetry], folder: Path
) -> None:
    """Copy meshes into ``folder`` and write their entries into the catalogue there, in the place of those of the same names.

    Raises
    ------
    Refused
        A name cannot be one of an object, or another object has it, or the catalogue cannot be read; then nothing was written.
    """
    catalogue = folder / "catalogue.toml"
    text = catalogue.read_text("utf-8") if catalogue.is_file() else ""
    entries = _parsed(text, catalogue)
    for path, symmetry in zip(files, symmetries, strict=True):
        name = path.stem
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise Refused(f"{name!r} cannot be a part's name: letters, digits, - and _ alone; rename the file")
        if name in entries and entries[name]["file"] != path.name:
            raise Refused(f"{catalogue}: another part is named {name} ({entries[name]['file']}); rename the file")
        kept = re.sub(rf"(?ms)^\[{re.escape(name)}\][^\n]*\n.*?(?=^\[(?!{re.escape(name)}\.)|\Z)", "", text).rstrip(
            "\n"
        )
        text = f"{kept}\n\n{catalogue_entry(path, unit, licence, description, symmetry)}".lstrip("\n")
    _parsed(text, catalogue)
    folder.mkdir(parents=True, exist_ok=True)
    for path in files:
        write_whole(folder / path.name, lambda target, path=path: shutil.copyfile(path, target))
    write_whole(catalogue, lambda target: target.write_text(text, "utf-8"))


def _parsed(text: str, catalogue: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise Refused(f"{catalogue}: would not be a catalogue any more ({error}); mend its entry by hand") from None


def catalogue_entry(path: Path, unit: str, licence: str, description: str, symmetry: Symmetry) -> str:
    """The TOML table of the object in a file."""

    def numbers(values: np.ndarray) -> str:
        return "[" + ", ".join(f"{v + 0.0:.9g}" for v in values) + "]"

    lines = [
        f"[{path.stem}]",
        f'file = "{path.name}"',
        f'unit = "{unit}"',
        f'sha256 = "{hashlib.sha256(path.read_bytes()).hexdigest()}"',
        f"licence = {json.dumps(licence, ensure_ascii=False)}",
        f"description = {json.dumps(description, ensure_ascii=False)}",
        f"[{path.stem}.symmetry]",
        f'kind = "{symmetry.kind}"',
        f"centre_mm = {numbers(np.round(1e3 * symmetry.centre, 4))}",
    ]
    if symmetry.axis is not None:
        lines.append(f"axis = {numbers(np.round(symmetry.axis, 5))}")
    turns = ", ".join(f"{{axis = {numbers(np.round(a, 5))}, order = {n}}}" for a, n in generators(symmetry))
    lines.append(f"turns = [{turns}]")
    return "\n".join(lines) + "\n"


def generators(symmetry: Symmetry) -> list[tuple[np.ndarray, int]]:
    """Few (axis, order) that generate the symmetry's elements, highest orders first."""
    rotvecs = Rotation.from_matrix(symmetry.elements[1:, :3, :3]).as_rotvec()
    chosen: list[tuple[np.ndarray, int]] = []
    size = 1
    for vector in sorted(
        rotvecs, key=lambda v: (round(float(np.linalg.norm(v)), 6), *np.round(-np.abs(v), 6), *np.round(-v, 6))
    ):
        angle = float(np.linalg.norm(vector))
        axis = np.round(vector / angle, 9)
        axis *= np.sign(axis[np.flatnonzero(axis)[0]])  # in either direction it generates the same turns
        trial = [*chosen, (axis + 0.0, round(2 * np.pi / angle))]
        larger = len(group_of([2 * np.pi / n * a for a, n in trial], symmetry.centre))
        if larger > size:
            chosen, size = trial, larger
    return chosen
