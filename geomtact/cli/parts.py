"""Several objects by one --object: names with commas between them, or a folder of mesh files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from geomtact.errors import InputError


def parts_of(object_name: str | None) -> list[str | None]:
    """The objects that ``--object`` names, each as it would be named alone; bundled ones of a folder by their names.

    Raises
    ------
    InputError
        A folder without meshes, or an object named twice.
    """
    from geomtact.geometry.catalogue import catalogue
    from geomtact.geometry.mesh_file import FORMATS

    if object_name is None or object_name in catalogue():
        return [object_name]
    if not object_name.strip():
        raise InputError("--object: expected an object's name or a mesh file, got an empty text; check your variables")
    folder = Path(object_name)
    if not folder.is_dir():
        names = [name.strip() for name in object_name.split(",")] if not folder.exists() else [object_name]
        if len(set(names)) < len(names) or "" in names:
            raise InputError(f"--object {object_name}: expected each object once, separated by commas")
        return list(names)
    bundled = {entry.file.resolve(): name for name, entry in catalogue().items()}
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in FORMATS and not p.name.startswith("."))
    if not files:
        raise InputError(f"--object {folder}: no mesh in this folder; expected {', '.join(FORMATS)}")
    return [bundled.get(path.resolve(), str(path)) for path in files]


def units_of(parts: Sequence[str | Path | None], unit: str | None) -> list[str | None]:
    """The unit to load each object with: of several, ``unit`` is for those that state none; None means the object's own.

    If every object states its own, ``unit`` goes to all, so that one which contradicts it is refused as it would be alone.
    """
    from geomtact.geometry.mesh_file import states_unit

    own = [part is not None and states_unit(part) for part in parts]
    return [None if stated and not all(own) else unit for stated in own]
