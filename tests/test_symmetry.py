"""Symmetry: the groups of simple solids come out in any frame, and every element maps the surface onto itself."""

import time

import numpy as np
import pytest
import trimesh
from speed import slow_but
from trimesh.creation import box, capsule, cone, cylinder, icosahedron, icosphere, torus

from geomtact.geometry.mesh_file import load_mesh
from geomtact.geometry.symmetry import Symmetry, about, find_symmetry, group_of
from geomtact.se3 import apply, random_rotations, transform

MM = 1e-3
CORNERS = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]
TETRAHEDRON = trimesh.Trimesh(CORNERS, [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def with_bump(mesh, at):
    bump = box((1, 1, 1))
    bump.apply_translation(at)
    return trimesh.util.concatenate([mesh, bump])


SOLIDS = {
    "brick": (box((10, 20, 30)), "discrete", 4),
    "square bar": (box((10, 10, 30)), "discrete", 8),
    "cube": (box((20, 20, 20)), "discrete", 24),
    "hexagonal prism": (cylinder(10, 20, sections=6), "discrete", 12),
    "hexagonal prism of equal moments": (cylinder(10, 15.6, sections=6), "discrete", 12),
    "tetrahedron": (TETRAHEDRON.copy().apply_scale(10), "discrete", 12),
    "icosahedron": (icosahedron().apply_scale(10), "discrete", 60),
    "cube with a bump at a face's middle": (with_bump(box((20, 20, 20)), (0, 0, 10)), "discrete", 4),
    "cube with a bump at a corner": (with_bump(box((20, 20, 20)), (10, 10, 10)), "discrete", 3),
    "cube with a bump elsewhere": (with_bump(box((20, 20, 20)), (3, 4, 10)), "none", 1),
    "cylinder of 32 sides": (cylinder(5, 20, sections=32), "axis", 2),
    "cylinder of 32 sides, too coarse": (cylinder(20, 50, sections=32), "discrete", 64),
    "cylinder of equal moments": (cylinder(10, 17.3, sections=64), "axis", 2),
    "cone": (cone(10, 20, sections=64), "axis", 1),
    "torus": (torus(20, 5, 96, 48), "axis", 2),
    "capsule": (capsule(30, 6), "axis", 2),
    "ball": (icosphere(4, 6), "sphere", 1),
}


QUICK = ("brick", "hexagonal prism", "tetrahedron", "cube with a bump at a corner", "cube with a bump elsewhere")


@pytest.mark.parametrize("name", slow_but(SOLIDS, *QUICK, "cylinder of 32 sides", "ball"))
def test_standard_groups_in_any_frame(name, rng):
    mesh, kind, count = SOLIDS[name]
    R = random_rotations(1, rng)[0]
    vertices = apply(transform(R, [0.01, -0.02, 0.3]), MM * mesh.vertices)
    found = find_symmetry(vertices, mesh.faces)
    assert (found.kind, len(found.elements)) == (kind, count)
    check_is_group(found.elements)
    check_maps_onto_itself(found, vertices, mesh.faces, 5e-5)
    if kind == "axis":
        assert abs(found.axis @ R[:, 2]) == pytest.approx(1, abs=1e-9)


def test_a_real_object_with_faces_of_no_area_has_its_symmetry(data_folder):
    """Such a face has no normal."""
    part = load_mesh(data_folder / "meshes_trimesh" / "dirty" / "wallhole.obj", "mm")
    found = find_symmetry(part.vertices, part.faces)
    assert (found.kind, len(found.elements)) == ("discrete", 2)
    check_maps_onto_itself(found, part.vertices, part.faces, 5e-5)


def check_maps_onto_itself(symmetry: Symmetry, vertices, faces, tolerance):
    """By brute force over all faces, apart from the finder's method; in both directions since a group holds its inverses."""
    # In millimetres: trimesh's closest point takes small areas for none.
    mesh = trimesh.Trimesh(vertices / MM, faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, 12, seed=5)
    elements = symmetry.sampled(24)
    picked = elements[np.linspace(0, len(elements) - 1, 8).astype(int)]
    for point in apply(picked, MM * points).reshape(-1, 3) / MM:
        nearest = trimesh.triangles.closest_point(mesh.triangles, np.broadcast_to(point, (len(faces), 3)))
        assert np.linalg.norm(nearest - point, axis=1).min() <= tolerance / MM + 1e-4


def check_is_group(elements):
    np.testing.assert_array_equal(elements[0], np.eye(4))
    distance = np.abs((elements[:, None] @ elements).reshape(-1, 1, 4, 4) - elements).max((2, 3))
    assert distance.min(1).max() < 1e-12
    assert (np.bincount(distance.argmin(1)) == len(elements)).all()


def test_a_mirror_is_no_rotation():
    mesh = load_mesh("bracket")  # a mirror image of itself but for two holes
    assert find_symmetry(mesh.vertices, mesh.faces).kind == "none"
    mirrored = trimesh.util.concatenate(
        [box((20, 30, 10)), box((6, 4, 8), transform=_at(3, 9, 7)), box((6, 4, 8), transform=_at(3, -9, 7))]
    )
    assert find_symmetry(MM * mirrored.vertices, mirrored.faces).kind == "none"


def _at(x, y, z):
    return transform(np.eye(3), [x, y, z])


def test_the_tolerance_is_a_distance():
    plain, dented = box((10, 20, 30)), box((10, 20, 30))
    vertices = np.array(dented.vertices)
    vertices[np.argmax(vertices.sum(1))] += 0.1
    assert len(find_symmetry(MM * plain.vertices, plain.faces).elements) == 4
    assert find_symmetry(MM * vertices, dented.faces, 5e-5).kind == "none"
    assert len(find_symmetry(MM * vertices, dented.faces, 3e-4).elements) == 4


def test_group_of_closes_and_is_exact():
    centre = np.array([0.01, 0.02, 0.03])
    cube = group_of(np.pi / 2 * np.array([[0, 0, 1], [1, 4e-6, 0]]), centre)
    assert cube.shape == (24, 4, 4)
    np.testing.assert_allclose(apply(cube, centre[None])[:, 0], np.tile(centre, (24, 1)), atol=1e-15)
    assert np.abs(cube[:, :3, :3] - np.round(cube[:, :3, :3])).max() < 1e-5
    assert np.abs((cube[:, None] @ cube)[:, :, None] - cube).max((3, 4)).min(2).max() < 1e-14
    assert group_of([], centre).shape == (1, 4, 4)


def test_sampled_turns_are_even():
    turns = Symmetry("axis", about(np.eye(3)[None], [0, 0, 1]), np.array([0.0, 0, 1]), np.array([0, 0, 1.0])).sampled(8)
    np.testing.assert_allclose(turns[0], np.eye(4), atol=1e-15)
    np.testing.assert_allclose(
        np.arctan2(turns[:, 1, 0], turns[:, 0, 0]) % (2 * np.pi), np.pi / 4 * np.arange(8), atol=1e-9
    )
    sphere = Symmetry("sphere", np.eye(4)[None], None, np.zeros(3)).sampled(24)
    assert len(sphere) == 576
    np.testing.assert_allclose(sphere[0], np.eye(4), atol=1e-12)
    for R in random_rotations(200, np.random.default_rng(0)):  # covering: no rotation is far from all
        cosine = (np.einsum("ij,gij->g", R, sphere[:, :3, :3]).max() - 1) / 2
        assert np.arccos(cosine) < np.radians(30)


@pytest.mark.parametrize("name", ["damping_pin", "elbow_pipe"])
def test_fast_enough(name):
    mesh = load_mesh(name)
    start = time.perf_counter()
    find_symmetry(mesh.vertices, mesh.faces)
    assert time.perf_counter() - start < 6  # 3 s on two free cores


@pytest.mark.slow
def test_real_objects(data_folder):
    def of(path, scale):
        mesh = trimesh.load_mesh(str(data_folder / path))
        return find_symmetry(scale * mesh.vertices, mesh.faces)

    round_peg = of("meshes_factory_nist/factory_round_peg_16mm_tight.obj", 1)
    assert (round_peg.kind, len(round_peg.elements)) == ("axis", 2)
    peg = of("meshes_factory_nist/factory_rectangular_peg_16mm_tight_subdiv_3x.obj", 1)
    assert (peg.kind, len(peg.elements)) == ("discrete", 4)
    assert of("meshes_ycb/061_foam_brick.obj", 0.01).kind == "none"
    assert of("meshes_factory_nist/factory_bolt_m12_tight.obj", 1).kind == "none"
    # A nut's thread is 0.2 mm off any turn about the bore, but a helix is its own image under a half turn across it.
    nut = of("meshes_factory_nist/factory_nut_m16_tight_subdiv_3x.obj", 1)
    assert len(nut.elements) <= 2
    assert (np.abs(nut.elements[1:, 2, 2] + 1) < 1e-6).all()
