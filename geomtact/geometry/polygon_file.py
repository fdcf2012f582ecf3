"""The polygons in a file of those formats that hold nothing else: STL, OBJ, PLY and OFF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomtact.errors import MeshError
from geomtact.geometry.obj_file import read_obj
from geomtact.geometry.off_file import read_off
from geomtact.geometry.ply_file import read_ply
from geomtact.geometry.polygons import Indices, Polygons
from geomtact.geometry.stl_file import read_stl

_LARGEST = 1e60  # whose squares of squares are numbers, too
READERS = {".stl": read_stl, ".obj": read_obj, ".ply": read_ply, ".off": read_off}


def read_polygons(path: Path) -> Polygons:
    """The faces in a file, in its own unit and frame, each with three corners or more.

    Raises
    ------
    MeshError
        A file that cannot be read, is cut short, or holds no faces.
    OSError
    """
    data = path.read_bytes()
    if not data:
        raise MeshError(f"{path}: the file is empty (0 bytes); export the mesh again")
    try:
        with np.errstate(all="ignore"):  # what is no number is refused below
            polygons = READERS[path.suffix.lower()](data)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None
    except Exception as error:  # noqa: BLE001 -- bytes of no sense fail in more ways than can be listed
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise MeshError(f"{path}: cannot be read as {path.suffix.lower()} ({reason}); export the mesh again") from None
    corners, n = polygons.corners, len(polygons.vertices)
    if len(corners) and (corners.min() < 0 or corners.max() >= n):
        raise MeshError(f"{path}: a face names a vertex that is not there (of {n}); export the mesh again")
    faces = polygons.without_repeats()
    if not len(faces.sizes):
        what = "only points or lines" if n else "nothing"
        raise MeshError(f"{path}: expected a surface of triangles, found {what}; export the mesh with its faces")
    if not (np.abs(faces.vertices[faces.corners]) < _LARGEST).all():  # NaN is not, either
        raise MeshError(f"{path}: vertices hold NaN, infinity or numbers beyond {_LARGEST:g}; export the mesh again")
    return faces


def read_triangles(path: Path) -> tuple[Polygons, Indices, Indices]:
    """The faces in a file, the triangles (F, 3) that cover them, and the face (F,) of each.

    Raises
    ------
    MeshError
        As :func:`read_polygons`; or a face crosses itself.
    OSError
    """
    polygons = read_polygons(path)
    try:
        return polygons, *polygons.triangles()
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None
