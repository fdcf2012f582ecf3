"""Files as they are: the triangles of a mesh or CAD file in its own unit, and which unit that is."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from meshprep import Refused
from meshprep.surface import Array, Faces, Surface

from geomtact.errors import MeshError
from geomtact.geometry.gltf_file import read_gltf
from geomtact.geometry.mesh_file import FORMATS as READ
from geomtact.geometry.mesh_file import PREPARED, states_unit
from geomtact.geometry.polygon_file import READERS, read_triangles
from geomtact.geometry.units import METRE_FORMATS, UNITS, stated_unit
from geomtact.sensing.sensor import Sensor

STEP = (".step", ".stp")
FORMATS = READ + PREPARED
_LARGEST_FILE = 500_000_000  # bytes
_THREE_MF = {
    "millimeter": "mm",
    "centimeter": "cm",
    "inch": "inch",
    "meter": "m",
    "mm": "mm",
    "cm": "cm",
    "m": "m",
    "in": "inch",
}
TESSELLATION = 0.01  # of STEP files: how far from their surface its triangles may lie [mm]


def states_own_unit(path: Path) -> bool:
    """Whether a file needs no unit."""
    return path.suffix.lower() in PREPARED or states_unit(path)


def read(path: Path, unit: str | None, sensor: Sensor, of_several: bool = False) -> tuple[Surface, str]:
    """The surface in a file, and its unit.

    Parameters
    ----------
    unit : "mm", "cm", "m", "inch" in upper or lower case, for files that state none; "auto" only proposes
    sensor : by whose window "auto" judges
    of_several : whether ``unit`` is given for several files, of which some state none, and so for these

    Raises
    ------
    Refused, geomtact.errors.MeshError
        Unreadable, empty, without unit, or with another one than was given.
    """
    suffix = path.suffix.lower()
    given, unit = unit, unit and unit.lower()
    if unit not in (None, "auto", *UNITS):
        raise Refused(f"unknown unit {given!r}; give --unit, one of {', '.join(UNITS)}, or auto for a proposal")
    if suffix not in FORMATS:
        raise Refused(f"not a supported mesh format; give one of {' '.join(FORMATS)}")
    if not path.is_file():
        raise Refused("no such file")
    if path.stat().st_size == 0:
        raise Refused("the file is empty (0 bytes); export the mesh again")
    if path.stat().st_size > _LARGEST_FILE:
        raise Refused(
            f"the file has {path.stat().st_size / 1e6:.0f} MB, more than {_LARGEST_FILE / 1e6:.0f}; export it coarser"
        )
    if suffix in METRE_FORMATS:
        own, surface = "m", _joined(*read_gltf(path))
    elif suffix in READERS:
        own, surface = stated_unit(path), _polygons(path)
    else:
        scene = _scene(path)
        own, surface = _own_unit(suffix, scene), _triangles(scene)
    if own is None and unit is None:
        raise Refused(
            f"the file does not state its unit; give --unit, one of {', '.join(UNITS)}, or auto for a proposal"
        )
    if own is not None and unit not in (None, "auto", own) and not of_several:
        raise Refused(f"the file says {own}, but --unit {unit} was given; leave the unit out")
    if suffix in STEP:  # trimesh gives metres
        surface = Surface(1e3 * surface.vertices, surface.faces)
    if own is None and unit == "auto":
        raise Refused(_proposal(surface, sensor))
    return surface, own or str(unit)


def _scene(path: Path):
    import trimesh

    options = {}
    if path.suffix.lower() in STEP:
        try:
            import cascadio  # noqa: F401
        except ImportError:
            raise Refused("STEP files need cascadio; install the extra with pip install 'geomtact[step]'") from None
        options = {"tol_linear": TESSELLATION, "tol_angular": 0.1}
    try:
        # process=False: trimesh would merge, drop and reorder by its own rules. From bytes: a name need not be UTF-8
        same = {"file_type": path.suffix[1:].lower(), "process": False, "skip_materials": True}
        return trimesh.load_scene(io.BytesIO(path.read_bytes()), **same, **options)
    except ImportError as error:
        raise Refused(
            f"reading {path.suffix} needs another package ({error}); install the extra 'geomtact[meshprep]'"
        ) from None
    except Exception as error:  # noqa: BLE001 -- a parser fails on bad bytes in more ways than can be listed
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise Refused(f"cannot be read as {path.suffix.lower()} ({reason}); export it again") from None


def _own_unit(suffix: str, scene) -> str:
    """The unit that a STEP or 3MF file states. STEP files are read in millimetres, whatever they are drawn in."""
    if suffix in STEP:
        return "mm"
    stated = str(scene.units or "millimeter").lower().removesuffix("s")
    if stated not in _THREE_MF:
        raise Refused(f"the file is in {stated}; export it in one of {', '.join(UNITS)}")
    return _THREE_MF[stated]


def _triangles(scene) -> Surface:
    try:
        mesh = scene.to_mesh()
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    except Exception:  # noqa: BLE001 -- a scene without triangles fails in more ways than can be listed
        vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    if not len(faces):
        what = "only points or lines" if scene.geometry else "nothing"
        raise Refused(f"expected a surface of triangles, found {what}; export the mesh with its faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise Refused(f"a face names a vertex that is not there (of {len(vertices)}); export the mesh again")
    return _joined(vertices, faces)


def _polygons(path: Path) -> Surface:
    try:
        polygons, faces, owner = read_triangles(path)
    except MeshError as error:
        raise Refused(str(error).removeprefix(f"{path}: ")) from None
    return replace(_joined(polygons.vertices, faces), polygons=polygons, owner=owner)


def _joined(vertices: Array, faces: Faces) -> Surface:
    """The surface of triangles, in their order, whose coinciding vertices are one."""
    used = vertices[np.unique(faces)]
    if not np.isfinite(used).all() or np.abs(used).max() > 1e9:
        raise Refused("vertices hold NaN, infinity or numbers beyond 1e9; export the mesh again")
    # exporters repeat a vertex for every face, or for its texture: to the last bit the same is one
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    surface = Surface(vertices, index.ravel()[faces]).tidied()
    if not surface.size > 0 or np.abs(used).max() > 1e6 * surface.size:
        raise Refused("its extent is nothing against its distance from the origin; export it near the origin")
    return surface


def _proposal(surface: Surface, sensor: Sensor) -> str:
    """Which units would make sense of a size, in words."""
    window = 2 * float(np.hypot(*sensor.half_window))
    sizes = {unit: surface.size * scale for unit, scale in UNITS.items()}
    # an object that a gripper holds: from a tenth of the window to twenty windows
    likely = [unit for unit, size in sizes.items() if 0.1 * window <= size <= 20 * window]
    words = ", ".join(f"{1e3 * sizes[u]:.3g} mm across in {u}" for u in likely or sizes)
    lead = "likely" if likely else "no unit makes it an object to be touched"
    return f"the unit is yours to give; {lead}: {words} (the window of {sensor.name} is {1e3 * window:.0f} mm). Give --unit"
