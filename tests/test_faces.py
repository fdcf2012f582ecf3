"""Plane faces of a mesh: what triangles make them up makes no difference, and the grid is finer about those that ask for it."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from geomtact.contact_space.build import choose_resolution
from geomtact.contact_space.resolution import disks_about_faces
from geomtact.geometry.cells import within_any
from geomtact.geometry.faces import plane_faces
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.geometry.orbits import images_of
from geomtact.sensing.sensor import Sensor

MM = 1e-3
TURNED = Rotation.from_euler("xyz", [20, 35, 50], degrees=True).as_matrix()


def mesh_of(solid: trimesh.Trimesh, R=None) -> Mesh:
    vertices = MM * np.asarray(solid.vertices)
    return Mesh(vertices if R is None else vertices @ R.T, solid.faces, "part", "mm")


def test_a_box_has_six_faces_as_wide_as_its_sides():
    faces = plane_faces(mesh_of(trimesh.creation.box((40, 30, 8))))
    assert len(faces) == 6
    assert [face.area for face in faces] == pytest.approx(MM**2 * np.repeat([1200, 320, 240], 2))
    assert [face.half_width for face in faces] == pytest.approx(MM * np.repeat([15, 4, 4], 2))
    assert [face.half_length for face in faces] == pytest.approx(MM * np.repeat([20, 20, 15], 2))
    normals = np.array([face.normal for face in faces])
    assert np.abs(normals).argmax(1).tolist() == [2, 2, 1, 1, 0, 0]
    assert normals.sum(0) == pytest.approx(np.zeros(3))


@pytest.mark.parametrize("cuts", [0, 3])
def test_the_object_frame_and_the_triangles_make_no_difference(cuts):
    solid = trimesh.creation.box((40, 30, 8))
    for _ in range(cuts):
        solid = solid.subdivide()
    here, there = plane_faces(mesh_of(solid)), plane_faces(mesh_of(trimesh.creation.box((40, 30, 8)), TURNED))
    assert len(here) == len(there) == 6
    for face in there:
        same = min(here, key=lambda other: np.linalg.norm(TURNED @ other.normal - face.normal))
        assert np.linalg.norm(TURNED @ same.normal - face.normal) < 1e-9
        assert (same.area, same.half_width) == pytest.approx((face.area, face.half_width))
        assert same.half_length == pytest.approx(face.half_length)


def facing_z(solid, sign):
    """Area and half width, mm, of the faces that look along +z or -z, the largest first."""
    faces = [face for face in plane_faces(mesh_of(solid)) if sign * face.normal[2] > 0.99]
    return [(face.area / MM**2, face.half_width / MM) for face in faces]


def test_steps_are_separate_faces_and_feet_are_one():
    low, high, foot = (trimesh.creation.box(size) for size in ((20, 20, 10), (10, 10, 14), (4, 4, 4)))
    (lower, _), upper = facing_z(trimesh.boolean.union([low, high]), 1)
    assert lower == pytest.approx(400 - 100) and upper == pytest.approx((100, 5))
    feet = [foot.copy() for _ in range(4)]
    for each, (x, y) in zip(feet, ((8, 8), (8, -8), (-8, 8), (-8, -8)), strict=True):
        each.apply_translation((x, y, -6))
    (floor, _), stand = facing_z(trimesh.boolean.union([low, *feet]), -1)
    assert floor == pytest.approx(400 - 64)
    assert stand == pytest.approx((64, np.sqrt(3 * (8**2 + 4**2 / 12))))


def test_a_rail_hides_no_pad_beside_it():
    """The larger of two faces of one direction is an edge, which asks for no finer grid, the other is none."""
    base, rail, pad = (trimesh.creation.box(size) for size in ((100, 24, 10), (100, 1.9, 8), (13, 13, 6)))
    rail.apply_translation((0, 10.5, 5))
    pad.apply_translation((0, -2, 4))
    base.vertices[base.vertices[:, 2] > 0, 1] *= 0.02  # a ridge: its own top is an edge too
    mesh = mesh_of(trimesh.boolean.union([base, rail, pad])).with_symmetry()
    up = [face for face in plane_faces(mesh) if face.normal[2] > 0.99]
    assert up[0].half_width < MM and max(face.half_width for face in up) > 6 * MM
    assert any(v[2] > 0.99 for v, _ in disks_about_faces(mesh, Sensor.load("gelslim"), None, 2))


def test_nearly_parallel_faces_share_a_disk():
    """A roof of 1 degree: one disk holds the middle cells of both."""
    roof = trimesh.convex.convex_hull(
        [
            (x, y, z)
            for x in (-20, 20)
            for y, z in ((-25, 0), (25, 0), (-25, -30), (25, -30), (0, 25 * np.tan(np.radians(0.5))))
        ]
    )
    up = [face for face in plane_faces(mesh_of(roof)) if face.normal[2] > 0.9]
    assert len(up) == 2
    disks = disks_about_faces(mesh_of(roof).with_symmetry(), Sensor.load("gelslim"), None, 2)
    assert sum(v[2] > 0.9 for v, _ in disks) == 1


def test_what_is_round_has_no_wide_face():
    assert all(face.half_width < 1.2 * MM for face in plane_faces(mesh_of(trimesh.creation.icosphere(4, 10))))
    rod = plane_faces(mesh_of(trimesh.creation.cylinder(10, 60, 64)))
    assert [face.half_width > MM for face in rod].count(True) == 2  # its ends; of the mantle each strip is one


def wide_faces(mesh):
    """The six widest plane faces that are no edges."""
    return [face for face in plane_faces(mesh) if face.half_length > 5.5 * MM and face.half_width > MM][:6]


def lifted(mesh, sensor, resolution):
    """How far the tilt of the nearest direction of the grid lifts each face's end, or the window's, off the gel [m]."""
    directions = resolution.directions(mesh.symmetry, None)
    images = np.concatenate([v @ mesh.symmetry.elements[:, :3, :3] for v in directions.vectors[:, None]])[:, 0]
    faces = wide_faces(mesh)
    tilt = np.arccos(np.clip(np.max([images @ face.normal for face in faces], 1), -1, 1))
    return np.minimum([face.half_length for face in faces], sensor.half_window.max()) * np.tan(tilt)


@pytest.mark.parametrize("name", ["bracket", "head", "elbow_pipe"])
@pytest.mark.parametrize("sensor", ["gelslim", "gelsight-mini"])
def test_some_pose_of_the_grid_shows_a_face_put_down_whole(name, sensor):
    """Of the six widest faces; of a grid without disks many are not."""
    mesh, sensor = load_mesh(name).with_symmetry(), Sensor.load(sensor)
    resolution = choose_resolution(mesh, sensor)
    mean = 0.5 * sensor.max_penetration
    assert lifted(mesh, sensor, resolution).max() < 0.1 * mean
    assert lifted(mesh, sensor, replace(resolution, disks=())).max() > mean


def test_faces_that_the_approach_rules_out_take_no_place():
    """The elbow has more than six wide faces; the last of them is met where the scene leaves it alone."""
    elbow, sensor = load_mesh("elbow_pipe").with_symmetry(), Sensor.load("gelslim")
    met = disks_about_faces(elbow, sensor, None, 1)
    wide = [face.normal for face in plane_faces(elbow) if face.half_length > 5.5 * MM and face.half_width > MM]
    left = [v for v in wide if not within_any(images_of(v[None], elbow.symmetry)[0], met, met[0][1] / 2.6)]
    assert len(met) == 6 and left
    assert within_any(left[0], disks_about_faces(elbow, sensor, [(left[0], 0.05)], 1))


def test_a_window_or_a_level_that_needs_no_disks_has_none():
    plate = mesh_of(trimesh.creation.box((60, 45, 30)), TURNED).with_symmetry()
    assert len(disks_about_faces(plate, Sensor.load("gelslim"), None, 2)) == 3  # opposite sides are one by symmetry
    assert disks_about_faces(plate, Sensor.load("digit"), None, 4) == []
    pinhole = Sensor("pinhole", (64, 48), (0.05 * MM, 0.05 * MM), 20 * MM, 2 * MM)
    assert disks_about_faces(plate, pinhole, None, 2) == []
    assert disks_about_faces(load_mesh("ball").with_symmetry(), Sensor.load("gelslim"), None, 2) == []
