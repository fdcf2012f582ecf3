"""Refinement improves poses in observable directions, leaves the rest alone, and is never overconfident."""

import dataclasses

import numpy as np
import pytest
from implementations import implementations
from refining import SENSOR, SHIFT, TURN, facing_down, is_sound, off, scene, stepped_block, told_error, touch

import geomtact.registration
from geomtact import se3
from geomtact.errors import MeshError, PoseError
from geomtact.inference.effort import GRID_ALONE
from geomtact.inference.modes import grown
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.icp import Icp
from geomtact.registration.observability import Spread
from geomtact.registration.protocol import Problem
from geomtact.registration.surface import Surface
from geomtact.sensing.elastic import elastic_contact
from geomtact.sensing.sensor import Sensor

trimesh = pytest.importorskip("trimesh")

# each start is off by SHIFT and TURN in a random direction
SPREAD = Spread(TURN / np.sqrt(3), SHIFT / np.sqrt(3))
REFINERS = implementations(geomtact.registration, "refine")


@pytest.fixture(scope="module")
def block():
    return scene(stepped_block())


@pytest.fixture(scope="module")
def ball():
    return scene(trimesh.creation.icosphere(5, 8e-3))


@pytest.mark.parametrize("refiner, part", [(FilterReg, 0.93), (Icp, 0.9)])
def test_a_pose_on_a_corner_comes_nearer_in_observable_directions(refiner, part, block):
    """Contacts of the narrow top: its sides and corners fix the position across the membrane and the turn about z."""
    surface, caster = block
    nearer, ratio, moved = [], [], []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform([-4e-3, -3e-3], [4e-3, 3e-3])
        T = facing_down(x, y, rng.uniform(0.4e-3, 1.2e-3), 9e-3, rng.normal(0, 0.02, 2), rng.uniform(-np.pi, np.pi))
        problem = make_problem(touch(caster, T), SENSOR)
        start = off(T, problem, rng)
        result = refiner(surface, SPREAD).refine(problem, start[None])
        is_sound(result, 1)
        before, after = told_error(result, T, start), told_error(result, T, result.T[0])
        nearer.append(bool(result.converged[0]) and len(result.observable[0]) >= 2 and after < before)
        if before > 0:
            ratio.append(after / before)
        on_rim = se3.apply(se3.inverse(T), problem.points)
        moved.append(
            [np.linalg.norm(se3.apply(P, on_rim) - problem.points, axis=1).mean() for P in (start, result.T[0])]
        )
    assert np.mean(nearer) >= part
    assert np.median(ratio) < 0.3
    # the contact itself comes nearer too, not just its most favourable directions
    start_distance, end_distance = np.median(moved, axis=0)
    assert end_distance < 0.75 * start_distance


@pytest.mark.parametrize("refiner", REFINERS)
def test_a_sparse_surface_costs_accuracy_but_not_belief(refiner):
    """Points farther apart than the rim's noise: the rim still lies on the surface between them."""
    ended, believed = [], []
    for n in (40000, 3000):
        surface, caster = scene(stepped_block(), n)
        assert (surface.spacing > 0.5e-3) == (n == 3000)
        for seed in range(20):
            rng = np.random.default_rng(seed)
            T = facing_down(*rng.uniform([-4e-3, -3e-3], [4e-3, 3e-3]), 0.8e-3, 9e-3, (0, 0), rng.uniform(0, 6))
            problem = make_problem(touch(caster, T), SENSOR)
            result = refiner(surface, SPREAD).refine(problem, off(T, problem, rng)[None])
            ended.append(told_error(result, T, result.T[0]))
            believed.append(result.converged[0])
    dense, sparse = np.median(np.reshape(ended, (2, 20)), 1)
    assert np.mean(believed[20:]) >= 0.9 * np.mean(believed[:20])
    assert sparse < 2 * dense + 0.1e-3


def test_covariance_covers_the_error_where_the_model_holds(block):
    """Errors in units of the stated covariance are those of six normal variables, or smaller."""
    surface, caster = block
    distances = []
    for seed in range(60):
        rng = np.random.default_rng(100 + seed)
        T = facing_down(*rng.uniform(-3e-3, 3e-3, 2), 0.8e-3, 9e-3, rng.normal(0, 0.03, 2), rng.uniform(-np.pi, np.pi))
        problem = make_problem(touch(caster, T), SENSOR)
        result = FilterReg(surface, SPREAD).refine(problem, off(T, problem, rng)[None])
        xi = se3.log(se3.inverse(result.T[0]) @ T)
        distances.append(xi @ np.linalg.solve(result.covariance[0], xi))
    assert np.median(distances) < 7 and np.percentile(distances, 90) < 16


@pytest.mark.parametrize("refiner", REFINERS)
def test_a_face_beyond_the_window_constrains_nothing_and_nothing_drifts(refiner):
    """All pixels in contact: no rim. One straight edge: only the shift across it (and turn along it) is observable."""
    plate = trimesh.creation.box((80e-3, 60e-3, 5e-3))
    surface, caster = scene(plate, 80000)
    spread = SPREAD
    full = make_problem(touch(caster, facing_down(0, 0, 0.8e-3, 2.5e-3)), SENSOR)
    T = facing_down(0, 0, 0.8e-3, 2.5e-3)
    result = refiner(surface, spread).refine(full, T[None])
    assert not result.converged[0] and len(result.observable[0]) == 0
    np.testing.assert_array_equal(result.T[0], T)

    converged, better = 0, 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        # the plate's edge at object x = +40 mm crosses the window; everything along the edge (y) is unknown
        T = facing_down(-40e-3 + rng.uniform(-2e-3, 2e-3), 0, 0.8e-3, 2.5e-3)
        problem = make_problem(touch(caster, T), SENSOR)
        start = off(T, problem, rng)
        result = refiner(surface, spread).refine(problem, start[None])
        is_sound(result, 1)
        assert len(result.observable[0]) <= 3
        converged += bool(result.converged[0])
        if not result.converged[0]:
            continue
        assert len(result.observable[0]) >= 1
        along = se3.apply(result.T[0] @ se3.inverse(start), problem.centre[None])[0] - problem.centre
        assert abs(along[1]) < 0.05e-3
        # a straight edge along the pixels is located to half a pixel
        better += told_error(result, T, result.T[0]) < 0.3 * told_error(result, T, start) + 0.5 * 0.3e-3
    # a start that lifts the plate off the membrane has no wall near the rim
    assert converged >= 18 and better >= converged - 1


@pytest.mark.parametrize("refiner", REFINERS)
def test_a_ball_constrains_its_position_along_the_membrane_only(refiner, ball):
    surface, caster = ball
    for seed in range(10):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform(-4e-3, 4e-3, 2)
        T = facing_down(x, y, 1e-3, 8e-3, turn=rng.uniform(-3, 3))
        problem = make_problem(touch(caster, T), SENSOR)
        start = off(T, problem, rng)
        result = refiner(surface, SPREAD).refine(problem, start[None])
        is_sound(result, 1)
        assert result.converged[0] and len(result.observable[0]) <= 3
        # without any turn about the ball's own centre, the start's shift is what is to be undone
        before, after = (np.linalg.norm(P[:2, 3] - T[:2, 3]) for P in (start, result.T[0]))
        assert after < max(0.35 * before, 0.15e-3)


def test_result_does_not_depend_on_the_object_frame(block):
    """The same object in another frame: same poses of the object, and covariances that agree about the contact."""
    surface, caster = block
    T = facing_down(1e-3, -1e-3, 0.8e-3, 9e-3, turn=0.4)
    problem = make_problem(touch(caster, T), SENSOR)
    start = off(T, problem, np.random.default_rng(3))
    B = se3.exp([0.4, -0.8, 1.1, 0.05, -0.02, 0.03])
    other = Surface(se3.apply(B, surface.points), surface.normals @ B[:3, :3].T)
    here = FilterReg(surface, SPREAD).refine(problem, start[None])
    there = FilterReg(other, SPREAD).refine(problem, (start @ se3.inverse(B))[None])
    np.testing.assert_allclose(there.T[0] @ B, here.T[0], atol=1e-7)
    assert len(here.observable[0]) == len(there.observable[0])
    # T B exp(xi) = T exp(Ad_B xi) B
    R, t = B[:3, :3], B[:3, 3]
    adjoint = np.block([[R, np.zeros((3, 3))], [se3.hat(t) @ R, R]])
    scale = np.repeat([here.length, 1.0], 3)
    np.testing.assert_allclose(
        there.covariance[0] * np.outer(scale, scale),
        adjoint @ here.covariance[0] @ adjoint.T * np.outer(scale, scale),
        rtol=1e-4,
        atol=1e-9,
    )


def test_rim_lies_on_the_outline_and_not_on_the_border_of_the_image():
    x, y = SENSOR.pixel_centres()
    centre = np.array([6e-3, 0.0])
    mask = np.hypot(x - centre[0], y[:, None] - centre[1]) < 5e-3
    problem = make_problem(mask, SENSOR, sink=0.0)
    assert 30 <= len(problem.points) <= 120
    radius = np.linalg.norm(problem.points[:, :2] - centre, axis=1)
    assert np.abs(radius - 5e-3).max() < 0.5 * 0.3e-3 and abs(radius.mean() - 5e-3) < 0.05 * 0.3e-3
    assert problem.points[:, 0].max() <= SENSOR.half_window[0]
    expected = (problem.points[:, :2] - centre) / radius[:, None]
    # at the border of the image the blur of the mask is one-sided
    clear = problem.points[:, 0] < SENSOR.half_window[0] - 4 * 0.3e-3
    assert (problem.facing[clear, :2] * expected[clear]).sum(1).min() > 0.95
    gaps = np.linalg.norm(np.diff(problem.points, axis=0), axis=1)
    assert np.ptp(gaps[gaps < 2 * np.median(gaps)]) < 0.3 * np.median(gaps)
    assert problem.weight[0] == pytest.approx(min(1, np.median(gaps) / (np.sqrt(np.pi) * 2e-3)), rel=0.1)


def test_specks_have_no_rim_and_a_curved_membrane_lifts_it():
    x, y = SENSOR.pixel_centres()
    mask = np.hypot(x, y[:, None]) < 4e-3
    clean = make_problem(mask, SENSOR, sink=0.0)
    mask[3, 3] = mask[40, 58] = mask[40, 59] = True
    np.testing.assert_allclose(make_problem(mask, SENSOR, sink=0.0).points.mean(0), clean.points.mean(0), atol=1e-5)
    curved = Sensor("curved", (64, 48), (0.3e-3, 0.3e-3), 20e-3, 2e-3, membrane_radius=30e-3)
    rim = make_problem(mask, curved, sink=0.0).points
    np.testing.assert_allclose(rim[:, 2], -curved.sag(rim[:, 0], rim[:, 1]), atol=1e-9)
    assert isinstance(clean, Problem) and (clean.points[:, 2] == 0).all()


@pytest.mark.slow
def test_open3d_repeats_itself_to_the_last_digit(pin, a_touch):
    """Its sums run over threads, and a weakly constrained rim turns another order of adding into another pose."""
    mask = pin.localize(a_touch(pin)[1], effort=GRID_ALONE).observation.contact.mask
    problem = make_problem(mask, pin.sensor)
    starts = pin.index.poses(np.array([cell for cell, _ in grown(pin.localize(a_touch(pin)[1], effort=GRID_ALONE), 3)]))
    icp = next(r for r in pin.mode_refiner.refiners(pin.index, True) if r.name == "icp")
    first = icp.refine(problem, starts).T
    assert all((first == icp.refine(problem, starts).T).all() for _ in range(15))


def ring(radius=4e-3):
    """Mask pixels of a thin ring: an outline of one pixel."""
    x, y = SENSOR.pixel_centres()
    return np.abs(np.hypot(x, y[:, None]) - radius) < 0.16e-3


def unsound():
    """Images that break registration written for clean ones, by name: (mask, height)."""
    x, y = SENSOR.pixel_centres()
    disk = np.hypot(x, y[:, None]) < 4e-3
    two = (np.hypot(x - 5e-3, y[:, None]) < 2e-3) | (np.hypot(x + 5e-3, y[:, None]) < 2e-3)
    few = np.zeros_like(disk)
    few[20, 30:33] = True
    eight = few.copy()
    eight[21:23, 30:33] = True
    eight[22, 32] = False
    height = np.where(disk, 0.5e-3, 0)
    broken = height.copy()
    broken[::3] = np.nan
    return {
        "a rim of one pixel": (ring(), None),
        "three pixels": (few, None),
        "eight pixels": (eight, None),
        "two patches": (two, None),
        "heights with gaps": (disk, broken),
        "no height anywhere": (disk, 0 * height),
        "all heights missing": (disk, np.full(disk.shape, np.nan)),
        "heights without a contact": (0 * disk, height),
    }


@pytest.mark.parametrize("refiner", REFINERS)
@pytest.mark.parametrize("name", unsound())
def test_unsound_images_end_in_a_sound_result(refiner, name, block):
    surface, _ = block
    mask, height = unsound()[name]
    starts = np.stack([facing_down(x, 0, 0.8e-3, 9e-3, turn=x) for x in (0.0, 2e-3)])
    result = refiner(surface, SPREAD).refine(make_problem(mask, SENSOR, height), starts)
    is_sound(result, 2)
    np.testing.assert_array_equal(result.T[~result.converged], starts[~result.converged])


def test_a_third_of_outliers_leaves_the_pose_where_it_belongs(block):
    """Points of the outline moved anywhere in the window: observable directions stay within half a pixel, by median."""
    surface, caster = block
    errors, before, believed = [], [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        T = facing_down(*rng.uniform(-3e-3, 3e-3, 2), 0.8e-3, 9e-3, turn=rng.uniform(-3, 3))
        problem = make_problem(touch(caster, T), SENSOR)
        astray = rng.random(len(problem.points)) < 0.3
        points = problem.points.copy()
        points[astray, :2] = rng.uniform(-SENSOR.half_window, SENSOR.half_window, (astray.sum(), 2))
        start = off(T, problem, rng)
        result = FilterReg(surface, SPREAD).refine(dataclasses.replace(problem, points=points), start[None])
        believed.append(result.converged[0])
        errors.append(told_error(result, T, result.T[0]))
        before.append(told_error(result, T, start))
    assert np.mean(believed) > 0.8 and np.median(errors) < 0.15e-3 < np.median(before)


def test_a_surface_drawn_point_to_point_comes_nearer_too(block):
    surface, caster = block
    ratio = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        T = facing_down(*rng.uniform(-3e-3, 3e-3, 2), 0.8e-3, 9e-3, turn=rng.uniform(-3, 3))
        problem = make_problem(touch(caster, T), SENSOR, sink=0.0)
        start = off(T, problem, rng)
        result = FilterReg(surface, SPREAD, objective="point").refine(problem, start[None])
        is_sound(result, 1)
        if result.converged[0]:
            ratio.append(told_error(result, T, result.T[0]) / told_error(result, T, start))
    assert len(ratio) > 10 and np.median(ratio) < 0.7


def test_heights_constrain_directions_that_the_outline_does_not(ball):
    """How deep a ball is pressed: an outline may belong to a gel that sinks around it, heights measure it."""
    surface, caster = ball
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T = facing_down(*rng.uniform(-3e-3, 3e-3, 2), 1e-3, 8e-3, turn=rng.uniform(-3, 3))
        contact = caster.contact(SENSOR, T)
        start = se3.transform(np.eye(3), [0.3e-3, -0.2e-3, 0.4e-3]) @ T
        found = {}
        for name, height in (("outline", None), ("heights", contact.height)):
            problem = make_problem(contact.mask, SENSOR, height)
            result = FilterReg(surface, Spread(TURN, 1e-3)).refine(problem, start[None])
            assert result.converged[0]
            covariance = result.T[0][:3, :3] @ result.covariance[0][3:, 3:] @ result.T[0][:3, :3].T
            found[name] = abs(result.T[0][2, 3] - T[2, 3]), np.sqrt(covariance[2, 2])
        assert found["heights"][0] < 0.05e-3 < found["outline"][0]
        assert found["heights"][1] < 0.5 * found["outline"][1]


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("size", [(8e-3, 6e-3, 10e-3), (2e-3, 2e-3, 10e-3)])
def test_gel_that_hangs_free_beside_a_punch_moves_nothing_sideways(size, soft):
    """Around a flat punch an elastic gel is half as deep only at twice its radius: nothing of the object is there."""
    surface, caster = scene(trimesh.creation.box(size), 30000)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        T = facing_down(*rng.uniform(-3e-3, 3e-3, 2), 1e-3, 5e-3, rng.uniform(-0.03, 0.03, 2), rng.uniform(-3, 3))
        depth = caster.depths(SENSOR, T[None])[0]
        height = elastic_contact(depth, SENSOR.pixel_pitch)[1] if soft else np.maximum(depth, 0)
        problem = make_problem(height > 3e-5, SENSOR, height)
        start = se3.transform(np.eye(3), [0.5e-3, -0.4e-3, 0.3e-3]) @ T
        result = FilterReg(surface, Spread(0.05, 0.7e-3)).refine(problem, start[None])
        is_sound(result, 1)
        top = [0, 0, 5e-3]
        before, after = (1e3 * (se3.apply(pose, [top]) - se3.apply(T, [top]))[0] for pose in (start, result.T[0]))
        assert np.linalg.norm(after[:2]) < np.linalg.norm(before[:2]) + 0.05
        assert not result.converged[0] or abs(after[2]) < 0.15 < abs(before[2])


def test_missing_heights_are_no_border_of_the_contact(block):
    """Where heights are missing nothing is measured: neither an outline nor membrane that was not met."""
    _, caster = block
    contact = caster.contact(SENSOR, facing_down(0, 0, 0.8e-3, 9e-3))
    gap = np.zeros(contact.mask.shape, bool)
    gap[:, 24:36] = True
    problem = make_problem(contact.mask & ~gap, SENSOR, np.where(gap, np.nan, contact.height))
    whole = make_problem(contact.mask, SENSOR, contact.height)
    x = SENSOR.pixel_centres()[0][[24, 35]] * [1.02, 0.98]
    for points in (problem.points, problem.around):
        assert len(points) > 5 and ((points[:, 0] < x[0]) | (points[:, 0] > x[1])).all()
    assert len(whole.points) > len(problem.points) - 10


def test_heights_on_a_bulging_membrane_lie_on_the_object():
    sensor = dataclasses.replace(SENSOR, membrane_radius=30e-3)
    ball = trimesh.creation.icosphere(5, 8e-3)
    _, caster = scene(ball)
    T = se3.transform(np.eye(3), [4e-3, 2e-3, 8e-3 - 1.2e-3])
    contact = caster.contact(sensor, T)
    problem = make_problem(contact.mask, sensor, contact.height)
    within = ~problem.across.any(1)
    off = np.linalg.norm(problem.points[within] - T[:3, 3], axis=1) - 8e-3
    assert within.sum() > 20 and np.abs(off).max() < 0.02e-3


@pytest.mark.parametrize("refiner", REFINERS)
def test_an_approach_that_leaves_no_tilt_gets_none(refiner, block):
    """Poses off an exact face would lie outside the contact pose space."""
    surface, caster = block
    spread = Spread.of_grid(np.radians(6), 1e-3, [((0, 0, 1), 0.0)])
    believed = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T = facing_down(*rng.uniform(-3e-3, 3e-3, 2), 0.8e-3, 9e-3, turn=rng.uniform(-3, 3))
        start = se3.transform(np.eye(3), [0.3e-3, -0.2e-3, 0]) @ T
        result = refiner(surface, spread).refine(make_problem(touch(caster, T), SENSOR), start[None])
        is_sound(result, 1)
        believed += result.converged[0]
        assert abs(result.T[0][2, 2] - T[2, 2]) < 1e-12
    assert believed > 7


def test_a_spread_of_zero_and_a_surface_of_one_point_are_refused():
    with pytest.raises(PoseError, match="must be greater than 0"):
        Spread(0.0, 1e-3)
    with pytest.raises(MeshError, match="needs 2 points or more, got 1"):
        Surface(np.zeros((1, 3)), np.ones((1, 3)))


def test_contacts_of_two_sensors_together_constrain_directions_that_each_leaves_open():
    """Two edges of a plate at right angles: each constrains the shift across itself, both constrain the place."""
    plate = trimesh.creation.box((80e-3, 60e-3, 5e-3))
    surface, caster = scene(plate, 80000)
    T_world_object = np.eye(4)
    # each sensor looks at the plate's underside, one over the edge at x = 40 mm, the other over that at y = 30 mm
    sensors = [
        se3.transform(np.eye(3), [40e-3, 5e-3, -2.5e-3 + 0.8e-3]),
        se3.transform(se3.exp([0, 0, 0.7, 0, 0, 0])[:3, :3], [-8e-3, 30e-3, -2.5e-3 + 0.6e-3]),
    ]
    problems = [make_problem(touch(caster, se3.inverse(S) @ T_world_object), SENSOR) for S in sensors]
    joint = Problem.joined(problems, np.array(sensors))
    assert joint.contacts == 2 and len(joint.points) == sum(len(p.points) for p in problems)
    start = se3.transform(np.eye(3), [0.5e-3, -0.6e-3, 0.0]) @ T_world_object
    spread = Spread(np.radians(1.0), 1e-3)
    errors = []
    for problem, S in zip(problems, sensors, strict=True):
        alone = FilterReg(surface, spread).refine(problem, (se3.inverse(S) @ start)[None])
        errors.append(np.linalg.norm((S @ alone.T[0])[:2, 3]))
    together = FilterReg(surface, spread).refine(joint, start[None])
    is_sound(together, 1)
    assert together.converged[0] and np.linalg.norm(together.T[0][:2, 3]) < 0.15e-3 < min(errors)
    # one contact alone, carried into the world, is what it was in its sensor's frame
    moved_alone = FilterReg(surface, spread).refine(Problem.joined(problems[:1], np.array(sensors[:1])), start[None])
    here = FilterReg(surface, spread).refine(problems[0], (se3.inverse(sensors[0]) @ start)[None])
    np.testing.assert_allclose(moved_alone.T[0], sensors[0] @ here.T[0], atol=1e-9)
    np.testing.assert_allclose(moved_alone.covariance[0], here.covariance[0], rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("unsure", [0.1e-3, 0.5e-3, 1e-3])
def test_the_uncertainty_of_an_outline_follows_the_probability_of_contact(unsure):
    """Where the outline errs by s, the probability of contact is that of a Gaussian of that width."""
    from scipy.stats import norm

    sensor = Sensor("plain", (320, 240), (1e-4, 1e-4), 0.0, 2e-3)
    x, y = np.meshgrid(*sensor.pixel_centres())
    beside = np.hypot(x - 1e-3, y) - 6e-3
    problem = make_problem(norm.cdf(-beside / unsure).astype(np.float32), sensor)
    sharp = make_problem(beside < 0, sensor)
    assert problem.noise == pytest.approx(np.maximum(unsure, sharp.noise[0]), rel=0.1)
    from_centre = problem.points[:, :2] - [1e-3, 0]
    radius = np.linalg.norm(from_centre, axis=1, keepdims=True)
    assert radius == pytest.approx(6e-3, abs=1e-5) and (sharp.noise == sharp.noise[0]).all()
    assert problem.facing[:, :2] == pytest.approx(from_centre / radius, abs=0.1)
