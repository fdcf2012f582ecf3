"""The bundled objects: the catalogue agrees with the files, the symmetry finder and the construction."""

import hashlib
import importlib.util
from pathlib import Path

import numpy as np
import pytest
import trimesh

from geomtact.geometry import catalogue as module
from geomtact.geometry.catalogue import catalogue, meshes_folder
from geomtact.geometry.mesh_file import load_mesh
from geomtact.geometry.symmetry import find_symmetry

X, Y, Z = np.eye(3)
# kind, number of elements, an axis of highest order (None: no symmetry or a sphere)
CONSTRUCTED = {
    "ball": ("sphere", 1, None),
    "bracket": ("none", 1, None),
    "connector_plug": ("none", 1, None),
    "damping_pin": ("axis", 1, Z),
    "elbow_pipe": ("discrete", 2, (X - Z) / np.sqrt(2)),
    "gear": ("discrete", 6, Z),
    "head": ("none", 1, None),
    "hex_nut": ("discrete", 12, Z),
    "pin": ("discrete", 2, Z),
    "stepped_shaft": ("none", 1, None),
}
THESIS = ("pin", "damping_pin", "head", "elbow_pipe")


def test_every_object_is_listed():
    assert set(catalogue()) == set(CONSTRUCTED)
    folder = next(iter(catalogue().values())).file.parent
    assert {p.stem for p in folder.glob("*.stl")} == set(CONSTRUCTED)


@pytest.mark.parametrize("name", CONSTRUCTED)
def test_the_catalogue_lists_measured_and_constructed_objects(name):
    entry, mesh = catalogue()[name], load_mesh(name)
    assert hashlib.sha256(entry.file.read_bytes()).hexdigest() == entry.sha256
    kind, count, axis = CONSTRUCTED[name]
    found = find_symmetry(mesh.vertices, mesh.faces)
    assert mesh.symmetry is entry.symmetry
    for symmetry in (found, entry.symmetry):
        assert (symmetry.kind, len(symmetry.elements)) == (kind, count)
    np.testing.assert_allclose(found.centre, entry.symmetry.centre, atol=1e-7)
    distance = np.abs(found.elements[:, None] - entry.symmetry.elements).max((2, 3))
    assert distance.min(1).max() < 2e-5
    if kind == "axis":
        np.testing.assert_allclose([found.axis, entry.symmetry.axis], [axis, axis], atol=1e-6)
    elif axis is not None:
        turned = entry.symmetry.elements[:, :3, :3] @ axis
        assert (np.linalg.norm(turned - axis, axis=1) < 1e-5).sum() == (6 if name in ("gear", "hex_nut") else 2)


@pytest.mark.parametrize("name", CONSTRUCTED)
def test_objects_are_closed_solids(name):
    entry, mesh = catalogue()[name], load_mesh(name)
    raw = trimesh.load_mesh(str(entry.file))
    assert raw.is_watertight
    assert raw.is_winding_consistent
    assert raw.volume > 0
    assert raw.body_count == 1
    assert 1000 <= len(mesh.faces) <= 25_000
    low, high = (0.1, 0.15) if name in THESIS else (0.0119, 0.07)
    assert low <= mesh.diameter <= high
    assert entry.licence == "MIT"
    assert entry.description


def test_ball_is_a_ball():
    np.testing.assert_allclose(np.linalg.norm(load_mesh("ball").vertices, axis=1), 0.006, atol=1e-8)


@pytest.mark.parametrize("name", ["ball", "hex_nut", "stepped_shaft"])
def test_objects_are_rebuilt_byte_for_byte(name):
    path = Path(__file__).resolve().parents[1] / "tools" / "make_meshes.py"
    spec = importlib.util.spec_from_file_location("make_meshes", path)
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    _, build = tool.PARTS[name]
    assert tool.stl_bytes(build()) == catalogue()[name].file.read_bytes()


def test_objects_are_found_next_to_an_installed_package(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "__file__", str(tmp_path / "geomtact" / "geometry" / "catalogue.py"))
    assert meshes_folder() is None
    (tmp_path / "geomtact_meshes").mkdir()
    (tmp_path / "geomtact_meshes" / "catalogue.toml").write_text("")
    assert meshes_folder() == tmp_path / "geomtact_meshes"
