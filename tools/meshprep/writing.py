"""The results of a repair: the mesh in its own unit, a picture, and a JSON file; all of them or none."""

from __future__ import annotations

import json
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from meshprep import Refused
from meshprep.adding import add
from meshprep.picture import draw
from meshprep.proof import Proof, is_solid, prove
from meshprep.repair import Work
from meshprep.surface import Surface

from geomtact.errors import MeshError
from geomtact.files import write_bytes
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.geometry.units import UNITS, unit_comment
from geomtact.json_values import plain
from geomtact.versions import versions


def write(before: Surface, work: Work, name: str, unit: str, out: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Prove what was done, and write it; the content of the JSON file.

    Raises
    ------
    Refused, geomtact.errors.MeshError
        The surface is not closed, or has moved by more than is allowed.
    """
    mm = 1e3 * UNITS[unit]
    bound = options["max_deviation_mm"] / mm
    after = work.surface
    if after.open_edges:
        edges, _, uses = after.half_edges
        where = ", ".join(f"{mm * x:.4g}" for x in after.vertices[edges[after.open_half_edges[0]]].mean(0))
        raise Refused(
            f"{after.open_edges} of {len(uses)} edges are left open, one at ({where}) mm; close the surface in CAD"
        )
    proof = prove(before, work)
    if proof.largest > bound + 1e-6 * before.size:  # no distance is more exact
        where = ", ".join(f"{mm * x:.4g}" for x in proof.worst)
        raise Refused(
            f"the repaired surface lies {mm * proof.largest:.3g} mm from the original at ({where}) mm, more than "
            f"{options['max_deviation_mm']:g}; repair it in CAD there, or allow it with --max-deviation"
        )
    parts = _parts(after, options["split"])
    names = [name if len(parts) == 1 else f"{name}_{i + 1}" for i in range(len(parts))]
    taken = sorted(set(names) & set(options["taken"]) - {name})
    if taken:
        raise Refused(f"--split would write over {taken[0]}; rename the file, or give another --out")
    told = {"schema": "geomtact/mesh-prep/1", "name": name, "unit": unit, "options": options}
    told |= _told(before, work, proof, mm) | {"parts": names}
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{each}.ply" for each in names]
        for file, part in zip(files, parts, strict=True):
            write_ply(file, part, unit)
        meshes = [_checked(file, unit, options["symmetry_mm"]) for file in files]
        told |= {"symmetry": _symmetry(meshes[0]), "versions": versions()}
        told["warnings"] = [
            *(before.polygons.warnings if before.polygons else ()),
            *(w for m in meshes for w in m.warnings),
        ]
        contents = {file.name: file.read_bytes() for file in files}
        contents[f"{name}.png"] = draw(name, unit, before, work, proof, max(bound, 1e-6 * before.size))
        contents[f"{name}.json"] = json.dumps(plain(told), indent=1).encode()
        if options["add_to"] is not None:
            words = options["description"] or f"made of {name}"
            symmetries = [mesh.symmetry for mesh in meshes if mesh.symmetry is not None]
            add(files, unit, options["licence"], words, symmetries, Path(options["add_to"]))
        for each, content in contents.items():
            write_bytes(out / each, content)
    return {key: value for key, value in told.items() if key not in ("schema", "options", "versions")}


def write_ply(path: Path, surface: Surface, unit: str) -> None:
    """Binary PLY whose coordinates are doubles: what was read is written to the last bit. A comment states the unit."""
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {unit_comment(unit)}\n"
        f"element vertex {len(surface.vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(surface.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(surface.faces), [("n", "u1"), ("corners", "<i4", 3)])
    rows["n"], rows["corners"] = 3, surface.faces
    path.write_bytes(header.encode() + surface.vertices.astype("<f8").tobytes() + rows.tobytes())


def _checked(file: Path, unit: str, tolerance_mm: float) -> Mesh:
    """The mesh as it will be loaded, with its symmetry, if it is a solid by every check."""
    try:
        mesh = load_mesh(file, unit)
    except MeshError as error:
        raise Refused(str(error).removeprefix(f"{file}: ")) from None
    wrong = is_solid(file)
    if wrong:
        raise Refused(f"what came of the repair is no solid: {wrong}; repair it in a mesh editor")
    return mesh.with_symmetry(1e-3 * tolerance_mm)


def _parts(surface: Surface, split: bool) -> list[Surface]:
    """The surface, or each of its bodies with the cavities in it, the largest first."""
    volume = surface.volumes
    if not split or (volume > 0).sum() < 2:
        return [surface]
    body, owner = surface.bodies, surface.owners
    solid = [k for k in np.argsort(-volume) if volume[k] > 0]
    return [surface.with_faces(surface.faces[owner[body] == k]).tidied() for k in solid]


def _symmetry(mesh: Mesh) -> dict[str, Any]:
    found = mesh.symmetry
    assert found is not None
    axis = None if found.axis is None else found.axis.tolist()
    return {
        "kind": found.kind,
        "order": len(found.elements),
        "axis": axis,
        "centre_mm": (1e3 * found.centre).tolist(),
    }


def _told(before: Surface, work: Work, proof: Proof, mm: float) -> dict[str, Any]:
    after = work.surface
    return {
        "outcome": "repaired" if work.changes else "clean",
        "changes": work.changes,
        "deviation_mm": mm * proof.largest,
        "output_from_input_mm": {"max": mm * proof.to_input[0], "mean": mm * proof.to_input[1]},
        "input_from_output_mm": {"max": mm * proof.to_output[0], "mean": mm * proof.to_output[1]},
        "worst_mm": [mm * x for x in proof.worst],
        "buried": proof.buried,
        "holes": [
            asdict(hole) | {"area": mm**2 * hole.area, "span": mm * hole.span, "middle": [mm * x for x in hole.middle]}
            for hole in work.holes
        ],
        "volume_mm3": {"before": mm**3 * before.volume, "after": mm**3 * after.volume},
        "area_mm2": {"before": mm**2 * before.area, "after": mm**2 * after.area},
        "faces": len(after.faces),
        "bodies": len(after.volumes),
        "vertices": {"kept_exactly": proof.kept, "new": proof.new},
    }
