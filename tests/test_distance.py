"""Laws of distances between poses: brute force over the symmetry group gives the same."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.geometry.mesh_file import load_mesh
from geomtact.se3 import apply, exp, random_rotations, transform

PARTS = ["connector_plug", "hex_nut", "gear", "damping_pin", "ball"]
each_object = pytest.mark.parametrize("name", PARTS)


def near_poses(n, rng, spread=0.3):
    return exp(np.concatenate([spread * rng.normal(size=(n, 3)), 5e-3 * rng.normal(size=(n, 3))], 1))


def by_brute_force(distance, T, others, over, n=1440):
    """Least distance over the symmetry group, its continuous subgroup in ``n`` steps."""
    mesh = distance.mesh
    here = apply(T, distance.points)
    out = []
    for other in others:
        images = other @ mesh.symmetry.sampled(n if mesh.symmetry.kind == "axis" else 36)
        d = np.linalg.norm(apply(images, distance.points) - here, axis=-1)
        out.append(over(d, axis=1).min())
    return np.array(out)


def test_without_symmetry_it_is_the_plain_mean(rng):
    mesh = load_mesh("connector_plug")
    assert mesh.symmetry.kind == "none"
    distance = PoseDistance(mesh)
    T, others = near_poses(1, rng)[0], near_poses(30, rng)
    d = np.linalg.norm(apply(others, distance.points) - apply(T, distance.points), axis=-1)
    assert distance.mean(T, others) == pytest.approx(d.mean(1), rel=1e-12)
    assert distance.largest(T, others) == pytest.approx(d.max(1), rel=1e-12)


@each_object
def test_of_all_images_one_is_nearest(name, rng):
    """Of the elements' images; those that turns about an axis make are as near as one another."""
    distance = PoseDistance(load_mesh(name), 128)
    T, others = np.eye(4), transform(random_rotations(40, rng), 5e-3 * rng.normal(size=(40, 3)))
    nearest = [distance.is_nearest(T, others @ S) for S in distance.mesh.symmetry.elements]
    assert (np.sum(nearest, 0) == 1).all()


@pytest.mark.parametrize("name", ["hex_nut", "gear", "damping_pin"])
def test_it_is_the_least_over_the_symmetry_group(name, rng):
    """Images are aligned in mean square, so the mean is a little above its own minimum."""
    distance = PoseDistance(load_mesh(name), 128)
    others = transform(random_rotations(40, rng), 5e-3 * rng.normal(size=(40, 3)))
    mean, largest = distance.mean(np.eye(4), others), distance.largest(np.eye(4), others)
    least = by_brute_force(distance, np.eye(4), others, np.mean)
    assert (mean > least - 1e-5).all() and (mean < 1.1 * least + 1e-5).all()
    assert (largest > by_brute_force(distance, np.eye(4), others, np.max) - 1e-5).all()

    images = load_mesh(name).symmetry.sampled(7)
    near = near_poses(40, rng, 0.05) @ images[rng.integers(len(images), size=40)]
    least = by_brute_force(distance, np.eye(4), near, np.mean)
    assert distance.mean(np.eye(4), near) == pytest.approx(least, rel=0.01, abs=1e-5)
    least = by_brute_force(distance, np.eye(4), near, np.max)
    assert distance.largest(np.eye(4), near) == pytest.approx(least, rel=0.05, abs=1e-5)


@each_object
def test_a_pose_and_its_images_are_no_distance_apart(name, rng):
    mesh = load_mesh(name)
    distance = PoseDistance(mesh)
    T = near_poses(1, rng)[0]
    assert distance.mean(T, T @ mesh.symmetry.sampled(24)).max() < 1e-9
    assert distance.largest(T, T @ mesh.symmetry.sampled(24)).max() < 1e-9


@each_object
def test_distances_do_not_change_with_the_frame_nor_with_the_order(name, rng):
    distance = PoseDistance(load_mesh(name))
    T, world, others = near_poses(1, rng)[0], exp(rng.normal(size=6)), near_poses(50, rng)
    assert distance.mean(world @ T, world @ others) == pytest.approx(distance.mean(T, others), abs=1e-9)
    back = np.array([distance.mean(o, T[None])[0] for o in others])
    assert back == pytest.approx(distance.mean(T, others), rel=0.03)


@each_object
@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_within_is_the_mean_below_the_radius(name, spread, rng):
    mesh = load_mesh(name)
    distance = PoseDistance(mesh, 128)
    T, others = np.eye(4), near_poses(400, rng, spread)
    images = others @ mesh.symmetry.sampled(6)[rng.integers(len(mesh.symmetry.sampled(6)), size=400)]
    d = distance.mean(T, images)
    for radius in (mode_radius(mesh), float(np.median(d))):
        clear = np.abs(d - radius) > 1e-9
        assert (distance.within(T, images, radius) == (d <= radius))[clear].all()


@each_object
def test_the_turn_alone_bounds_the_distance(name, rng):
    """What modes are searched by: a rotation turned() puts beyond three radii has no pose within one."""
    mesh = load_mesh(name)
    distance, radius = PoseDistance(mesh, 128), mode_radius(mesh)
    R = random_rotations(2000, rng)
    R[:1000] = Rotation.from_rotvec(0.15 * rng.normal(size=(1000, 3))).as_matrix()
    turned = distance.turned(np.eye(3), R)
    # the best shift of each rotation is about the one that keeps the mean of the points
    T = transform(R, distance.points.mean(0) - R @ distance.points.mean(0))
    mean = distance.mean(np.eye(4), T)
    assert (turned[mean <= radius] <= 3 * radius).all()
    if mesh.symmetry.kind == "none":
        about = distance.points - distance.points.mean(0)
        rms = np.sqrt((np.linalg.norm(about @ np.swapaxes(R, 1, 2) - about, axis=-1) ** 2).mean(1))
        assert turned == pytest.approx(rms, rel=1e-9)


@each_object
def test_symmetry_leaves_the_anchor_in_place(name):
    mesh = load_mesh(name)
    distance = PoseDistance(mesh)
    moved = apply(mesh.symmetry.sampled(12), distance.anchor[None])[:, 0]
    assert np.abs(moved - distance.anchor).max() < 1e-9


def test_the_radius_of_a_mode_is_5_mm_or_5_percent():
    ball = load_mesh("ball")
    assert mode_radius(ball) == pytest.approx(0.05 * ball.diameter)
    head = load_mesh("head")
    assert mode_radius(head) == pytest.approx(min(5e-3, 0.05 * head.diameter))
