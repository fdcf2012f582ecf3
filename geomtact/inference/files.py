"""Posteriors on disk: one npz file without pickles, complete in itself."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.contact_space.resolution import MAX_POSES
from geomtact.contact_space.store import open_index
from geomtact.errors import GeomtactError, InputError
from geomtact.files import write_whole
from geomtact.geometry.approach import to_json
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.symmetry import Symmetry
from geomtact.inference.distribution import CellDistribution, Refined, row_log_prob, row_poses
from geomtact.inference.explored import Explored
from geomtact.inference.facts import Diagnostics, Provenance
from geomtact.inference.reference import Reference
from geomtact.se3 import check_pose, check_transforms
from geomtact.sensing.sensor import Sensor

_KEPT, _MOST = 0.99, 50_000  # share of the mass whose poses are written, and their largest number; hand-set
_OFF = 1e-3  # largest deviation of the sum of probabilities from 1; hand-set
WITHOUT_PRIOR = (
    "this file lacks the prior and other sensors: it holds only that one sensor without contact rules poses out"
)
_FORMAT = "geomtact/posterior/13"
_BROKEN = (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, EOFError)


def save(posterior: CellDistribution, path: str | Path) -> None:
    """Write ``posterior`` to ``path``: poses, log_prob, frame, object_sha256, sensor_toml, seed, and what
    :func:`load` needs.

    A posterior may be spread over a million poses. For other programs the most probable are written out, those that
    hold 99 % of the mass but at most 50,000, with log_prob normalised over them; ``row_log_prob`` holds all cells, of the
    numbers ``row_cell``. What begins with ``explored`` is of a posterior resolved within the cells; it is empty for others.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    log_prob = row_log_prob(posterior)
    p = np.exp(log_prob)
    order = np.argsort(-p, kind="stable")
    some = np.sort(order[: min(_MOST, int(np.searchsorted(np.cumsum(p[order]), _KEPT)) + 1)])
    refined, symmetry, reference = posterior.refined, posterior.index.mesh.symmetry, posterior.reference
    assert symmetry is not None
    provenance = posterior.provenance
    if posterior.off_contact_log_density is not None:
        provenance = provenance.without_prior()
    keys = np.array(sorted(refined), np.int64)
    meta = {
        "format": _FORMAT,
        "object": posterior.index.mesh.name,
        "unit": posterior.index.mesh.unit,
        "symmetry": symmetry.kind,
        "approach": to_json(posterior.index.approach),
        "contact": posterior.contact,
        "log_evidence": posterior.log_evidence,
        "provenance": provenance.to_json(),
        "diagnostics": asdict(posterior.diagnostics),
        "warnings": posterior.warnings + [WITHOUT_PRIOR] * provenance.lacks_prior,
        "refined": [[refined[int(k)].length, refined[int(k)].moved, refined[int(k)].observable.tolist()] for k in keys],
    }
    explored = posterior.explored.arrays() if posterior.explored else {}
    arrays = {
        "poses": row_poses(posterior, some),
        "log_prob": log_prob[some] - (np.log(p[some].sum()) if len(some) else 0.0),
        "frame": np.array(posterior.frame),
        "object_sha256": np.array(posterior.index.mesh.sha256),
        "sensor_toml": np.array(posterior.index.sensor.to_toml()),
        "seed": np.array(posterior.seed),
        "row_cell": posterior.cells,
        "row_log_prob": posterior.cell_log_prob,
        "index_poses": np.array(len(posterior.index)),
        "T_frame_sensor": posterior.T_frame_sensor,
        "symmetry_elements": symmetry.elements,
        "symmetry_line": np.stack([symmetry.centre, np.zeros(3) if symmetry.axis is None else symmetry.axis]),
        "vertices": posterior.index.mesh.vertices,
        "faces": posterior.index.mesh.faces,
        "index_key": np.array(posterior.index.key),
        "refined_cells": keys,
        "refined_T": np.array([refined[int(k)].T for k in keys]).reshape(-1, 4, 4),
        "refined_covariance": np.array([refined[int(k)].covariance for k in keys]).reshape(-1, 6, 6),
        "reference_poses": np.zeros((0, 4, 4)) if reference is None else reference.poses,
        "reference_log_mass": np.zeros(0) if reference is None else reference.log_mass,
        "meta": np.array(json.dumps(meta)),
        **{f"explored_{name}": value for name, value in explored.items()},
    }

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:  # given a name, numpy would add .npz to it
            np.savez(file, allow_pickle=False, **arrays)

    try:
        write_whole(Path(path), write)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); give a file in a folder that is there"
        ) from None


def heading(path: str | Path) -> tuple[str, str, str]:
    """The object's name and sha256, and the frame, of a saved posterior, without opening its index.

    Raises
    ------
    InputError
        As of :func:`load`.
    """
    data, meta = _read(file_of(path), ("object_sha256", "frame", "meta"))
    return meta["object"], str(data["object_sha256"]), str(data["frame"])


def load(path: str | Path, cache_dir: str | Path | None = None) -> CellDistribution:
    """Read a posterior, from its file or the folder that holds it as posterior.npz; its index is opened from the cache, or built
    again where it is missing.

    Raises
    ------
    InputError
        The file cannot be read, or is no posterior.
    CacheError
        Its index cannot be opened or built.
    """
    path = file_of(path)
    data, meta = _read(path)
    try:
        mesh = Mesh(data["vertices"], data["faces"], meta["object"], meta["unit"], symmetry=_symmetry(data, meta))
        sensor = Sensor.from_toml(str(data["sensor_toml"]), str(path))
        cells, log_prob = data["row_cell"], data["row_log_prob"]
        poses, seed = int(data["index_poses"]), int(data["seed"])
        frame, evidence = str(data["frame"]), float(meta["log_evidence"])
        _check(mesh.sha256 == str(data["object_sha256"]), "its mesh is not the one that its checksum names")
        _check(frame in ("sensor", "world"), f"frame {frame!r}")
        _check_rows(cells, log_prob, poses)
        T_frame_sensor = check_pose(data["T_frame_sensor"], "T_frame_sensor")
        provenance = Provenance.from_json(meta["provenance"])
        diagnostics = Diagnostics(**meta["diagnostics"])
        extra, reference = meta["refined"], None
        if len(data["reference_poses"]):
            expected, log_mass = check_transforms(data["reference_poses"]), data["reference_log_mass"]
            _check(log_mass.shape == expected.shape[:1], "reference poses without their mass")
            reference = Reference(expected, log_mass)
        refined = {
            int(k): Refined(T, C, np.array(rows).reshape(-1, 6), length, moved)
            for k, T, C, (length, moved, rows) in zip(
                data["refined_cells"], data["refined_T"], data["refined_covariance"], extra, strict=True
            )
        }
    except (*_BROKEN, GeomtactError) as error:
        raise _not_saved(path, error) from None
    max_poses = provenance.max_poses or MAX_POSES
    index = open_index(mesh, sensor, meta["approach"], max_poses, cache_dir, key=str(data["index_key"]))
    if poses != len(index):
        raise InputError(f"{path}: its poses are not those of this version's grid; localize again")

    def of_sensor(toml: str, key: str) -> Index:
        other = Sensor.from_toml(toml, str(path))
        if other == sensor:
            return index
        return open_index(mesh, other, meta["approach"], max_poses, cache_dir, key=key)

    try:
        held = {name.removeprefix("explored_"): value for name, value in data.items() if name.startswith("explored_")}
        explored = Explored.of_arrays(index, held, of_sensor) if held else None
    except (*_BROKEN, GeomtactError) as error:
        raise _not_saved(path, error) from None
    return CellDistribution(
        index,
        cells,
        log_prob,
        frame=frame,
        T_frame_sensor=T_frame_sensor,
        contact=bool(meta["contact"]),
        log_evidence=evidence,
        seed=seed,
        refined=refined,
        explored=explored,
        reference=reference,
        provenance=provenance,
        diagnostics=diagnostics,
        warnings=meta["warnings"],
    )


def file_of(path: str | Path) -> Path:
    """The file of a posterior that is named by itself, or by the folder in which it lies as posterior.npz.

    Raises
    ------
    InputError
        There is none.
    """
    file = Path(path) / "posterior.npz" if Path(path).is_dir() else Path(path)
    if not file.is_file():
        what = "no posterior.npz in that folder" if Path(path).is_dir() else "no such file"
        raise InputError(f"{path}: {what}; give a posterior.npz, or its folder")
    return file


def _read(path: Path, names: Sequence[str] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """The arrays of ``names``, or all, and the texts."""
    try:
        if not zipfile.is_zipfile(path):  # numpy would take it for a pickle
            raise ValueError("it is no .npz file, or not a whole one")
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in names or file.files}
        meta = json.loads(str(data["meta"]))
        if meta["format"] != _FORMAT:
            raise ValueError(f"format {meta['format']!r}, not {_FORMAT!r}: localize again")
    except _BROKEN as error:
        raise _not_saved(path, error) from None
    return data, meta


def _check_rows(cells: NDArray[Any], log_prob: NDArray[Any], poses: int) -> None:
    """ValueError where cells are none of a grid of so many ``poses``, or no distribution over it."""
    _check(cells.ndim == 1 and cells.dtype.kind in "iu" and log_prob.shape == cells.shape, "rows of different length")
    if len(cells):
        inside = cells[0] >= 0 and cells[-1] < poses and (cells[:-1] < cells[1:]).all()
        _check(bool(inside), "cells that are not of its grid")
        total = float(np.exp(log_prob.astype(float)).sum())
        _check(abs(total - 1) < _OFF, f"probabilities that add up to {total:.3g}")


def _check(holds: bool, wrong: str) -> None:
    if not holds:
        raise ValueError(wrong)


def _not_saved(path: str | Path, error: Exception) -> InputError:
    return InputError(f"{path}: not a posterior that geomtact saved ({error}); give a posterior.npz")


def _symmetry(data: dict[str, Any], meta: dict[str, Any]) -> Symmetry:
    centre, axis = data["symmetry_line"]
    return Symmetry(meta["symmetry"], data["symmetry_elements"], axis if axis.any() else None, centre)
