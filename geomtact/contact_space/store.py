"""The cache of built indexes: a folder an index, named by the hash of all that went into it.

An entry is written under a temporary name and renamed, so it is whole or absent.
"""

from __future__ import annotations

import contextlib
import copyreg
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geomtact.contact_space.build import build, choose_resolution
from geomtact.contact_space.index import Index
from geomtact.contact_space.resolution import MAX_POSES, Resolution
from geomtact.errors import CacheError, UsageError, did_you_mean
from geomtact.geometry.approach import Approach, check_approach, to_json
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.symmetry import Symmetry
from geomtact.progress import Progress, between
from geomtact.sensing.sensor import Sensor

if TYPE_CHECKING:
    import filelock

FORMAT = 11  # raise whenever a built index would differ
DEFAULT_LIMIT = 20 * 10**9
_KEPT = 4  # indexes that a process has read for pickles and keeps
_CHOOSING = 0.1  # share of the time that choosing the grid takes, about
_KEY_LENGTH, _KEY_AT_LEAST = 32, 6  # hexadecimal digits of an entry's name, and by how many it may be named


@dataclass(frozen=True)
class CacheEntry:
    """One cached index: what it is for, its size, and when it was last read (seconds since 1970).

    ``approach`` is None where any side may be touched, and where it was written before that was noted.
    """

    key: str
    object: str
    sensor: str
    poses: int
    approach: list[tuple[list[float], float]] | None
    size_bytes: int
    last_used: float
    folder: Path


def default_cache_dir() -> Path:
    """``$GEOMTACT_CACHE``, else the user's cache folder."""
    if os.environ.get("GEOMTACT_CACHE"):
        return Path(os.environ["GEOMTACT_CACHE"])
    import platformdirs

    return Path(platformdirs.user_cache_dir("geomtact"))


def lock_of(entry: Path) -> filelock.BaseFileLock:
    """The lock that who makes something of an ``entry``'s folder holds."""
    import filelock

    return filelock.FileLock(entry.with_name(f"{entry.name}.lock"))


def open_index(
    mesh: Mesh,
    sensor: Sensor,
    approach: Approach | None = None,
    max_poses: int = MAX_POSES,
    cache_dir: str | Path | None = None,
    progress: Progress | None = None,
    key: str | None = None,
) -> Index:
    """The index of ``mesh`` on ``sensor``: from the cache, or built and cached.

    Two processes that want the same one build it once: the second waits for the first. ``key`` names the entry to
    look for, where it is stated.

    Raises
    ------
    MeshError
        No pose of the object touches the sensor as the approach and the housing allow.
    UsageError
        The approach or ``max_poses`` make no sense.
    CacheError
        The cache folder cannot be written, or the disk is full.
    """
    folder = Path(cache_dir) if cache_dir is not None else default_cache_dir()
    index = _read(folder / key, mesh, sensor, approach) if key else None
    key = _key(mesh, sensor, approach, max_poses)
    index = index or _read(folder / key, mesh, sensor, approach)
    if index is not None:
        return index
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with lock_of(folder / key):
            index = _read(folder / key, mesh, sensor, approach)
            if index is None:
                mesh = mesh.with_symmetry()
                chosen = between(progress, 0, _CHOOSING)
                resolution = choose_resolution(mesh, sensor, approach, max_poses, chosen)
                arrays = build(mesh, sensor, approach, resolution, between(progress, _CHOOSING, 1))
                index = Index(mesh, sensor, approach, resolution, key, folder=None, **arrays)
                _write(folder, index)
                if cache_dir is None:
                    bound_cache(DEFAULT_LIMIT, folder, keep=key)
    except OSError as error:
        raise CacheError(
            f"cache folder {folder}: cannot be written ({error.strerror or error}); "
            "free space there, or give another folder with --cache-dir or GEOMTACT_CACHE"
        ) from None
    return _read(folder / key, mesh, sensor, approach) or index


def cache_entries(cache_dir: str | Path | None = None) -> list[CacheEntry]:
    """All cached indexes, last used first; those that another version wrote, or that are damaged, are listed too."""
    folder = Path(cache_dir) if cache_dir is not None else default_cache_dir()
    entries = []
    for path in folder.glob("[0-9a-f]" * _KEY_LENGTH):
        with contextlib.suppress(OSError):
            files = [f.stat() for f in path.iterdir()]
            size, used = sum(f.st_size for f in files), max((f.st_mtime for f in files), default=0.0)
            try:
                meta = json.loads((path / "meta.json").read_text("utf-8"))
                what = meta["object"], meta["sensor"], meta["poses"], meta.get("approach")
            except (OSError, ValueError, KeyError):
                what = "damaged", "?", 0, None
            entries.append(CacheEntry(path.name, *what, size, used, path))
    return sorted(entries, key=lambda e: -e.last_used)


def bound_cache(limit_bytes: int, cache_dir: str | Path | None = None, keep: str = "") -> list[CacheEntry]:
    """Remove the entries used longest ago until the cache holds at most ``limit_bytes``; returns what was removed."""
    too_many, total = [], 0
    for entry in cache_entries(cache_dir):
        total += entry.size_bytes
        if total > limit_bytes and entry.key != keep:
            too_many.append(entry)
    return _removed(too_many)


def remove_from_cache(names: Sequence[str], cache_dir: str | Path | None = None) -> list[CacheEntry]:
    """Remove the indexes of objects of these ``names``, or whose keys begin so; returns what was removed.

    Raises
    ------
    UsageError
        One of the names fits none; then nothing is removed.
    """
    entries = cache_entries(cache_dir)

    def meant(name: str, entry: CacheEntry) -> bool:
        return name == entry.object or (len(name) >= _KEY_AT_LEAST and entry.key.startswith(name))

    for name in names:
        if not any(meant(name, entry) for entry in entries):
            near = did_you_mean(name, {entry.object for entry in entries})
            raise UsageError(f"cache: expected objects or keys that geomtact cache lists, got {name!r}{near}")
    return _removed([entry for entry in entries if any(meant(name, entry) for name in names)])


def _removed(entries: list[CacheEntry]) -> list[CacheEntry]:
    for entry in entries:
        shutil.rmtree(entry.folder, ignore_errors=True)
    return [entry for entry in entries if not entry.folder.exists()]


def clear_cache(cache_dir: str | Path | None = None) -> list[CacheEntry]:
    """Remove every cached index and what interrupted runs left behind; returns what was removed.

    What a running process builds at the moment is left alone.
    """
    import filelock

    folder = Path(cache_dir) if cache_dir is not None else default_cache_dir()
    removed = bound_cache(0, folder)
    for path in folder.glob("*.lock"):
        with contextlib.suppress(filelock.Timeout, OSError), filelock.FileLock(path, timeout=0):
            path.unlink(missing_ok=True)
            _clear_left(folder, path.stem)
    return removed


def _clear_left(folder: Path, key: str) -> None:
    """Remove what a killed run has left half built of an entry, whose lock is held."""
    for left in folder.glob(f"building-{key}-*"):
        shutil.rmtree(left, ignore_errors=True)


def _key(mesh: Mesh, sensor: Sensor, approach: Approach | None, max_poses: int) -> str:
    s = mesh.symmetry
    symmetry = (
        None if s is None else (s.kind, s.elements.round(9).tolist(), None if s.axis is None else s.axis.tolist())
    )
    text = json.dumps([FORMAT, mesh.sha256, symmetry, sensor.sha256, to_json(check_approach(approach)), max_poses])
    return hashlib.sha256(text.encode()).hexdigest()[:_KEY_LENGTH]


def _write(folder: Path, index: Index) -> None:
    symmetry = index.mesh.symmetry
    assert symmetry is not None
    meta = {
        "format": FORMAT,
        "object": index.mesh.name,
        "object_sha256": index.mesh.sha256,
        "sensor": index.sensor.name,
        "poses": len(index),
        "approach": to_json(check_approach(index.approach)),
        "resolution": index.resolution.to_json(),
        "symmetry": {
            "kind": symmetry.kind,
            "elements": symmetry.elements.tolist(),
            "axis": None if symmetry.axis is None else symmetry.axis.tolist(),
            "centre": symmetry.centre.tolist(),
        },
    }
    _clear_left(folder, index.key)
    building = folder / f"building-{index.key}-{secrets.token_hex(4)}"
    building.mkdir()
    try:
        for name in Index.ARRAYS:
            np.save(building / f"{name}.npy", getattr(index, name), allow_pickle=False)
        (building / "meta.json").write_text(json.dumps(meta), "utf-8")
        shutil.rmtree(folder / index.key, ignore_errors=True)
        building.rename(folder / index.key)
    except BaseException:
        shutil.rmtree(building, ignore_errors=True)
        raise


def _read(folder: Path, mesh: Mesh, sensor: Sensor, approach: Approach | None) -> Index | None:
    """The cached index, or None where it is absent or damaged (it is then rebuilt)."""
    try:
        meta = json.loads((folder / "meta.json").read_text("utf-8"))
        if meta["format"] != FORMAT:
            return None
        arrays = {a: np.load(folder / f"{a}.npy", allow_pickle=False) for a in Index.ARRAYS}
        s = meta["symmetry"]
        axis = None if s["axis"] is None else np.array(s["axis"])
        symmetry = Symmetry(s["kind"], np.array(s["elements"]), axis, np.array(s["centre"]))
        resolution = Resolution.from_json(meta["resolution"])
    except (OSError, EOFError, ValueError, KeyError, TypeError):
        return None
    with contextlib.suppress(OSError):  # a read-only cache still serves
        os.utime(folder / "meta.json")
    mesh = replace(mesh, symmetry=symmetry)
    return Index(mesh, sensor, approach, resolution, folder.name, folder=folder.absolute(), **arrays)


def _reopened(folder: Path, mesh: Mesh, sensor: Sensor, approach: Approach | None) -> Index:
    """The index in the ``folder`` of a cache entry, of which a pickle holds no more; each process reads it once."""
    # sensors are equal if they see alike, however their images are read; and so are meshes of one surface
    key = folder, repr((mesh.sha256, mesh.name, mesh.unit, mesh.path, mesh.warnings)), sensor.to_toml()
    if key not in _REOPENED:
        index = _read(folder, mesh, sensor, approach)
        if index is None:
            raise CacheError(
                f"cache entry {folder}: the index of {mesh.name!r} on {sensor.name!r}, which a pickle refers to, is not there; "
                "prepare the object again with this cache folder, or pickle where it is"
            )
        if len(_REOPENED) == _KEPT:
            del _REOPENED[next(iter(_REOPENED))]
        _REOPENED[key] = index
    return _REOPENED[key]


def _reduced(index: Index) -> tuple[Any, ...]:
    """How an index is pickled: by its entry in the cache, or by its arrays where it has none."""
    if index.folder is None:
        return Index, tuple(getattr(index, field.name) for field in fields(index))
    return _reopened, (index.folder, index.mesh, index.sensor, index.approach)


_REOPENED: dict[tuple[Path, str, str], Index] = {}
copyreg.pickle(Index, _reduced)  # type: ignore[arg-type]
