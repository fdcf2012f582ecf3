"""An object's mesh from its file, checked before anything is computed from it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import MeshError, did_you_mean, nearest_name
from geomtact.files import printable
from geomtact.geometry.catalogue import catalogue
from geomtact.geometry.gltf_file import read_gltf
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.polygon_file import read_triangles
from geomtact.geometry.solid import check_solid, folded_faces, place_mm
from geomtact.geometry.symmetry import Symmetry
from geomtact.geometry.units import METRE_FORMATS, UNITS, stated_unit, unit_comment
from geomtact.se3 import Array

UNITLESS_FORMATS = (".stl", ".obj", ".ply", ".off")
FORMATS = UNITLESS_FORMATS + METRE_FORMATS
PREPARED = (".step", ".stp", ".3mf")  # that tools/prep_mesh.py makes meshes of
_REEXPORT = "; if its numbers are {unit}, re-export it in metres, or save it as STL or PLY and give --unit {unit}"

_FLAT = 5e-5  # m: by which tools/prep_mesh.py lets a surface move, too
# m2, and share of the surface: from which folds are refused. Touches have 1 mm2 of contact at least; of all real meshes at
# hand the most is 0.2 mm2, a share of 3e-5, on a scanned marker.
_FOLDED, _FOLDED_SHARE = 1e-6, 1e-3
# Beyond these no tactile sensor is meant; they also keep squares and cubes of lengths far from overflow.
_SMALLEST, _LARGEST = 1e-4, 1e3


class _SensorLike(Protocol):
    """What the scale check needs of a sensor, which is a later stage."""

    @property
    def name(self) -> str: ...
    @property
    def half_window(self) -> Array: ...
    @property
    def pixel_pitch(self) -> tuple[float, float]: ...


def load_mesh(source: str | Path | Mesh, unit: str | None = None, *, sensor: _SensorLike | None = None) -> Mesh:
    """Load an object by catalogue name or from an STL, OBJ, PLY, OFF, GLB or glTF file. The object frame is the file's.

    Parameters
    ----------
    source : name in ``meshes/catalogue.toml``, path of a file, or a Mesh (checked against the sensor only)
    unit : "mm", "cm", "m" or "inch" in upper or lower case; needed for files that state none (see
        :func:`geomtact.geometry.units.stated_unit`), not for catalogue objects and glTF (metres)
    sensor : if given, the object's size is checked against its window

    Returns
    -------
    Mesh
        Vertices are rounded to single precision in metres (below 4 nm up to 125 mm, as mesh files hold them), vertices closer
        than 1e-7 of the size are welded, and vertices and faces are put in a canonical order: the same
        surface has the same ``sha256`` whatever the order, the format or the unit it was stored in.

    Raises
    ------
    MeshError
        Unknown name, no or contradicting unit, unreadable, cut short, empty, a face that crosses itself, not closed, inside out,
        folded back onto itself, or of an impossible size; or the name of a sensor in place of one.
    """
    if isinstance(source, Mesh):
        mesh = source
    else:
        name, path, unit, symmetry = _resolve(source, unit)
        raw_vertices, raw_faces, warnings = _read_triangles(path, unit)
        vertices, faces = _tidy(raw_vertices * UNITS[unit], raw_faces, path, unit)
        check_solid(vertices, faces, path)
        warnings += _check_folds(vertices, faces, path)
        mesh = Mesh(vertices, faces, name, unit, path, symmetry, warnings)
    if isinstance(sensor, str | os.PathLike):
        raise MeshError(f"sensor: expected a geomtact.Sensor, got {str(sensor)!r}; give geomtact.Sensor.load of it")
    if sensor is not None:
        _check_scale(mesh, sensor)
    return mesh


def _resolve(source: str | Path, unit: str | None) -> tuple[str, Path, str, Symmetry | None]:
    """Name, file, unit and symmetry, where stated, of a catalogue name or a path."""
    if not isinstance(source, str | os.PathLike):
        raise MeshError(
            f"expected an object's name, the path of a mesh file or a geomtact.Mesh, got {type(source).__name__}; make one by "
            'geomtact.Mesh(vertices, faces, "name", "m")'
        )
    text = str(source)
    objects = catalogue()
    path = Path(text)
    name = _catalogue_name(text)
    if unit is not None:
        given, unit = unit, str(unit).lower()
        if unit not in UNITS:
            raise MeshError(f"{text}: unknown unit {given!r}; give --unit (unit=) mm, cm, m or inch")
    if name is not None:
        entry = objects[name]
        if unit is not None and unit != entry.unit:
            raise MeshError(
                f"{text}: the catalogue's unit is {entry.unit}, but the unit {unit} was given; leave the unit out"
            )
        return name, entry.file, entry.unit, entry.symmetry
    suffix = path.suffix.lower()
    if suffix in PREPARED and path.is_file():
        raise MeshError(f"{text}: not read as it is; make a mesh of it with 'python tools/prep_mesh.py {path.name}'")
    if suffix not in (*FORMATS, *PREPARED):
        if path.exists():
            raise MeshError(f"{text}: not a mesh format that is read here; give one of {' '.join(FORMATS)}")
        raise MeshError(
            f"no object named {text!r}{nearest_name(text, objects)}; or give a mesh file ({' '.join(FORMATS)})"
        )
    if not path.is_file():
        beside = [p.name for p in path.parent.glob("[!.]*") if p.suffix.lower() in FORMATS]
        hint = (
            did_you_mean(path.name, beside) or f"; give the path of a mesh, or an object: {', '.join(sorted(objects))}"
        )
        raise MeshError(f"{text}: no such file{hint}")
    if suffix in METRE_FORMATS and unit not in (None, "m"):
        raise MeshError(
            f"{text}: glTF is in metres by definition, but the unit {unit} was given; leave the unit out"
            f"{_REEXPORT.format(unit=unit)}"
        )
    stated = stated_unit(path)
    if None not in (unit, stated) and unit != stated:
        raise MeshError(
            f"{text}: a comment in it states the unit {stated}, but the unit {unit} was given; leave the unit out, or mend "
            f"the comment ({unit_comment(str(unit))!r}) if that is wrong"
        )
    unit = unit or stated
    if unit is None:
        raise MeshError(f"{text}: the file does not state its unit; give --unit (unit=) mm, cm, m or inch")
    return printable(path.stem), path, unit, None


def states_unit(source: str | Path) -> bool:
    """Whether an object needs no unit: one of the catalogue, or a file that states its own."""
    try:
        return _catalogue_name(str(source)) is not None or stated_unit(Path(source)) is not None
    except (MeshError, OSError):  # which loading the file reports
        return False


def _catalogue_name(text: str) -> str | None:
    """The name of the object in the catalogue that a name or a path means."""
    objects = catalogue()
    return text if text in objects else next((n for n, e in objects.items() if e.file == Path(text).resolve()), None)


def _read_triangles(path: Path, unit: str) -> tuple[Array, NDArray[np.int64], tuple[str, ...]]:
    """Vertices (V, 3) in the file's unit, triangles (F, 3), and what was assumed."""
    if path.suffix.lower() in METRE_FORMATS:
        return *read_gltf(path), ()
    polygons, faces, _ = read_triangles(path)
    warnings = tuple(f"{path.name}: {text}" for text in polygons.warnings)
    bent = UNITS[unit] * polygons.thickness()
    count = int((bent > _FLAT).sum())
    if count:
        warnings += (
            f"{path.name}: {count} of {len(bent)} faces are not flat, by up to {_mm(bent.max())}, and what lies between their "
            "corners is not certain; cut them into triangles in the program that made them",
        )
    return polygons.vertices, faces, warnings


def _tidy(vertices: Array, faces: NDArray, path: Path, unit: str) -> tuple[Array, NDArray[np.int32]]:
    """Weld and order: the same surface gives the same arrays, whatever file it came from."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    with np.errstate(over="ignore"):
        size = float(np.linalg.norm(vertices.max(0) - vertices.min(0)))
        reach = float(np.abs(vertices).max())
    if not _SMALLEST <= size <= _LARGEST or reach > 1e3 * size:
        raise MeshError(
            f"{path}: {_mm(size)} across and up to {_mm(reach)} from the origin as read in {unit}, expected "
            f"{_mm(_SMALLEST)} to {_mm(_LARGEST)} near the origin; {_wrong_unit(path)}"
        )
    vertices = vertices.astype(np.float32).astype(np.float64) + 0.0  # + 0.0 turns -0 into 0
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    # CAD exports repeat a vertex with the last bit different, which would leave hairline cracks.
    pairs = cKDTree(vertices).query_pairs(1e-7 * size, output_type="ndarray")
    if len(pairs):
        near = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(vertices),) * 2)
        _, label = connected_components(near, directed=False)
        _, first = np.unique(label, return_index=True)
        faces = first[label][faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    if len(faces) == 0:
        raise MeshError(f"{path}: every face has shrunk to a line; export the mesh again")
    kept, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    start = faces.argmin(1)[:, None]
    faces = np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    return vertices[kept], faces.astype(np.int32)


def _check_folds(vertices: Array, faces: NDArray[np.int32], path: Path) -> tuple[str, ...]:
    """Refuse a surface that is folded back onto itself where a sensor would touch it; of less, a warning."""
    folded = folded_faces(vertices, faces)
    if not len(folded):
        return ()
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    area, where = areas[folded].sum(), vertices[faces[folded[areas[folded].argmax()]]]
    fault = (
        f"faces of {1e6 * area:.3g} mm2 are folded back onto their neighbours in one plane, one about "
        f"({place_mm(where)}) mm, as a fan of triangles does that stands for a polygon"
    )
    if area > min(_FOLDED_SHARE * areas.sum(), _FOLDED):
        raise MeshError(
            f"{path}: {fault}; export it with its polygons (OBJ, PLY, OFF), or mend it there in a mesh editor"
        )
    return (f"{path.name}: {fault}",)


def _check_scale(mesh: Mesh, sensor: _SensorLike) -> None:
    """Refuse an object of less than ten pixels or more than fifty windows: with real objects the unit is wrong then."""
    smallest = 10 * min(sensor.pixel_pitch)
    largest = 50 * 2 * float(np.hypot(*sensor.half_window))
    if not smallest <= mesh.diameter <= largest:
        raise MeshError(
            f"{mesh.path or mesh.name}: {_mm(mesh.diameter)} across as read in {mesh.unit}, but sensor {sensor.name} "
            f"suits {_mm(smallest)} to {_mm(largest)}; {_wrong_unit(mesh.path)}"
        )


def _wrong_unit(path: Path | None) -> str:
    metres = path is not None and path.suffix.lower() in METRE_FORMATS
    return "the unit is likely wrong" + (_REEXPORT.format(unit="mm") if metres else f"; give one of {', '.join(UNITS)}")


def _mm(metres: float) -> str:
    """A length in millimetres with three digits, written without an exponent."""
    mm = 1e3 * metres
    if mm < 1e-3:
        return "less than 0.001 mm"
    if mm > 1e9:
        return "more than 1,000,000,000 mm"
    return f"{mm:,.0f} mm" if mm >= 100 else f"{mm:.3g} mm"
