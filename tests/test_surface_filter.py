"""The compiled search for the surface that a contact meets finds what a search of all points finds."""

import numpy as np
import pytest
from refining import SENSOR, facing_down, off, scene, stepped_block, touch

from geomtact.kernels.parts import by_parts
from geomtact.kernels.surface_filter import _coarsely, _nearest
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.observability import Spread
from geomtact.registration.surface import Surface
from geomtact.se3 import apply, inverse, unit


def random_surface(n, seed):
    rng = np.random.default_rng(seed)
    return Surface(rng.uniform(-0.02, 0.03, (n, 3)) * [1, 0.3, 2], unit(rng.normal(size=(n, 3)))), rng


@pytest.mark.parametrize("n, count", [(2, 2), (50, 6), (3000, 6), (3000, 1)])
@pytest.mark.parametrize("turn", [0.0, 2e-3])
def test_the_nearest_points_are_those_of_all(n, count, turn):
    surface, rng = random_surface(n, n + count)
    number, distance2 = np.empty(count, np.int64), np.empty(count)
    for _ in range(200):
        x, facing = rng.uniform(-0.06, 0.09, 3), unit(rng.normal(size=3))
        _nearest(x, facing, turn**2, *surface.voxels, 1.0, number, distance2)
        to_all = np.square(surface.voxels.points - x).sum(1)
        to_all = to_all + turn**2 * np.square(surface.voxels.normals - facing).sum(1)
        np.testing.assert_allclose(distance2, np.sort(to_all)[:count], rtol=1e-12)
        np.testing.assert_allclose(to_all[number], distance2, rtol=1e-12)


def test_voxels_hold_every_point_once():
    surface, _ = random_surface(3000, 0)
    voxels = surface.voxels
    order = np.lexsort(surface.points.T)
    np.testing.assert_array_equal(voxels.points[np.lexsort(voxels.points.T)], surface.points[order])
    np.testing.assert_array_equal(voxels.normals[np.lexsort(voxels.points.T)], surface.normals[order])


def test_a_bound_on_the_distance_is_one():
    """However far away, and within a voxel's diagonal about the surface."""
    surface, rng = random_surface(500, 1)
    far = surface.far
    for x in rng.uniform(-0.1, 0.1, (500, 3)):
        least = _coarsely(x, far.distance, far.shape, far.low, far.side)[1]
        true = np.linalg.norm(surface.points - x, axis=1).min()
        assert least <= true + 1e-12
        inside = ((x > far.low) & (x < far.low + far.side * far.shape)).all()
        assert not inside or true - least <= np.sqrt(3) * far.side + 1e-12


def test_parts_come_in_their_order():
    for n in (0, 1, 7, 100):
        rows = np.concatenate([np.arange(n)[part] for part in by_parts(lambda part: part, n, 7)])
        np.testing.assert_array_equal(rows, np.arange(n))


def test_a_search_leads_more_poses_home_than_refining_does():
    """Of 200 starts that are off by 2 mm and 0.3 rad, twice as far as the filter is first wide."""
    surface, caster = scene(stepped_block())
    refiner, home = FilterReg(surface, Spread(0.1, 1e-3)), np.zeros(2)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T = facing_down(*rng.uniform([-4e-3, -3e-3], [4e-3, 3e-3]), 0.8e-3, 9e-3, (0, 0), rng.uniform(-np.pi, np.pi))
        problem = make_problem(touch(caster, T), SENSOR)
        starts = np.stack([off(T, problem, rng, 2e-3, 0.3) for _ in range(200)])
        rows, searched = refiner.search(problem, starts, lambda poses: np.arange(len(poses)), 200)
        np.testing.assert_array_equal(rows, np.arange(200)[::-1])
        for i, result in enumerate((refiner.refine(problem, starts), searched)):
            moved = apply(inverse(result.T), problem.points) - apply(inverse(T), problem.points)
            home[i] += np.sum(np.linalg.norm(moved, axis=-1).mean(-1) < 0.5e-3)
    print(home)
    assert home[1] > 1.2 * home[0] > 0, home
