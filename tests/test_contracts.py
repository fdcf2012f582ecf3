"""Laws that every implementation keeps: scores, refiners, ray scenes and motions, each found where it is defined."""

import dataclasses
from itertools import combinations

import numpy as np
import pytest
from implementations import implementations
from refining import SENSOR, SHIFT, TURN, facing_down, is_sound, off, scene, stepped_block, told_error, touch
from speed import slow_but

import geomtact.inference
import geomtact.registration
import geomtact.scoring
import geomtact.sensing.scene
from geomtact import se3
from geomtact.contact_space.store import open_index
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.motion_kernel import Mixture, MotionKernel
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.observability import Spread, motion_of
from geomtact.registration.protocol import Problem
from geomtact.registration.surface import Surface
from geomtact.scoring import fitted
from geomtact.scoring.calibration import FLOORS, simulate_touches
from geomtact.scoring.catalogue import SCORERS
from geomtact.scoring.fitted import fitted_scorer
from geomtact.sensing.cast import Caster
from geomtact.sensing.sensor import Sensor

# --- scores

TOUCHES = 60  # that each score is fitted on; the laws are coarse enough for it
POOR = ("l1", "hu", "fpfh")  # the thesis's pixel distance, and those that are blind to where a contact lies
ONLY_BY_WEIGHTS = {"CosineScorer"}  # of a user's own trained network


@pytest.fixture(scope="module")
def index(cache_dir):
    """Few poses, so that a score takes a moment, of a plug's one face, so that they lie millimetres apart."""
    plug, sensor = load_mesh("connector_plug"), Sensor.load("gelslim")
    return open_index(plug, sensor, [((0, 0, 1), 0.0)], 6_000, cache_dir, None)


@pytest.fixture(scope="module")
def fit(index, tmp_path_factory):
    """Every score as it is fitted on that grid, by its name."""
    folder, found = tmp_path_factory.mktemp("fits"), {}

    def of(name, again=False):
        if again or name not in found:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(fitted, "TOUCHES", TOUCHES)
                if again:
                    patch.setattr(fitted, "simulate_touches", lambda *_, **__: pytest.fail("fitted again"))
                scorer = fitted_scorer(name, index, folder)
            if again:
                return scorer
            found[name] = scorer
        return found[name]

    return of


@pytest.fixture(scope="module")
def touches(index):
    return simulate_touches(index, 40, seed=8)


@pytest.fixture(params=SCORERS)
def score(request):
    return request.param


def odd_masks(shape):
    """A pixel, a line, everything."""
    masks = np.zeros((3, *shape), bool)
    masks[0, shape[0] // 3, 5] = masks[1, shape[0] // 2] = masks[2] = True
    return masks


def test_every_score_is_reached_by_a_name(fit):
    """One that is added to the package but not to the catalogue is not tested here."""
    reached, waiting = set(), [fit(name) for name in SCORERS]
    while waiting:
        each = waiting.pop()
        reached.add(type(each).__name__)
        inside = [getattr(each, name, None) for name in ("scorer", "scorers")]
        waiting += [one for some in inside for one in (some if isinstance(some, list | tuple) else [some]) if one]
    defined = {each.__name__ for each in implementations(geomtact.scoring, "score")}
    assert defined - reached <= ONLY_BY_WEIGHTS


def test_a_score_has_the_grids_shape_is_finite_and_repeats(score, fit, index, touches):
    scorer = fit(score).scorer
    for mask in (touches.masks[0], *odd_masks(touches.masks[0].shape)):
        before = mask.copy()
        found = scorer.score(index, mask)
        assert found.shape == index.height.shape and found.dtype == np.float32 and np.isfinite(found).all()
        assert np.array_equal(found, scorer.score(index, mask)) and np.array_equal(mask, before)


def test_probabilities_of_0_and_1_score_as_the_mask_does(score, fit, index, touches):
    scorer, mask = fit(score).scorer, touches.masks[1]
    expected = scorer.score(index, mask)
    assert scorer.score(index, mask.astype(np.float32)) == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_a_score_is_calibrated_and_ranks_the_true_cell(score, fit, index, touches):
    """By the median over touches with noise, the share of poses that are likelier than the true one: half by chance."""
    found, w = fit(score), np.asarray(index.weight).ravel()
    assert found.calibration.temperature > 0 and FLOORS[0] <= found.calibration.floor <= FLOORS[-1]
    above, log_density = [], []
    for mask, true in zip(touches.masks, touches.ids, strict=True):
        rows = found.rows(index, mask)
        assert rows.cells.shape == rows.score.shape == rows.log_prior.shape
        flat = found.scorer.score(index, mask).ravel()
        above.append(w[flat > flat[true]].sum())
        joint = rows.score / found.calibration.temperature + rows.log_prior
        likelihood = np.exp(joint - np.logaddexp.reduce(joint) - rows.log_prior)
        floor = found.calibration.floor
        log_density.append(np.log((1 - floor) * likelihood[rows.cells == true][0] + floor))
    # no score costs anything, trusted as far as it is: twice the standard error of 40 touches is left
    assert np.mean(log_density) > -2 * np.std(log_density) / np.sqrt(len(log_density))
    assert np.median(above) < (0.4 if score in POOR else 0.2)


def test_a_fitted_score_is_read_back(score, fit, index, touches):
    first, again = fit(score), fit(score, again=True)
    assert (again.name, again.scorer.name, again.calibration) == (first.name, first.scorer.name, first.calibration)
    assert np.array_equal(again.scorer.score(index, touches.masks[2]), first.scorer.score(index, touches.masks[2]))


# --- refiners

# each start is off by SHIFT and TURN in a random direction
SPREAD = Spread(TURN / np.sqrt(3), SHIFT / np.sqrt(3))
REFINERS = implementations(geomtact.registration, "refine")
each_refiner = pytest.mark.parametrize("refiner", REFINERS, ids=lambda each: each.__name__)


@pytest.fixture(scope="module")
def block():
    return scene(stepped_block())


@pytest.fixture(scope="module")
def pressed(block):
    """A touch of the block: its pose, what was observed, and four starts off it."""
    T = facing_down(1e-3, -1e-3, 0.8e-3, 9e-3, turn=0.4)
    problem = make_problem(touch(block[1], T), SENSOR)
    return T, problem, np.stack([off(T, problem, np.random.default_rng(seed)) for seed in range(4)])


def distance_of(problem, surface, T):
    """How far the points of a contact lie from the planes of the object's surface, in the mean [m]."""
    points = se3.apply(se3.inverse(T), problem.points)
    near = surface.tree.query(points)[1]
    return np.abs(((points - surface.points[near]) * surface.normals[near]).sum(1)).mean()


def test_every_refiner_is_found():
    assert len(REFINERS) >= 2 and len({each(None, SPREAD).name for each in REFINERS}) == len(REFINERS)


@each_refiner
def test_a_refiner_repeats_and_comes_no_farther_from_the_surface(refiner, block, pressed):
    """Neither than its start nor, from where it ended, than that."""
    (surface, _), (T, problem, starts) = block, pressed
    result, again = (refiner(surface, SPREAD).refine(problem, starts) for _ in range(2))
    is_sound(result, len(starts))
    np.testing.assert_allclose(again.T, result.T, atol=1e-9)
    assert result.converged.sum() >= 3
    for i in np.flatnonzero(result.converged):
        before, after = (distance_of(problem, surface, pose) for pose in (starts[i], result.T[i]))
        assert after <= before + 0.1 * problem.pitch
        assert told_error(result, T, result.T[i], i) < told_error(result, T, starts[i], i) + 0.1 * problem.pitch
    further = refiner(surface, SPREAD).refine(problem, result.T)
    both = result.converged & further.converged
    assert both.sum() >= 3 and (further.residual[both] <= 1.1 * result.residual[both] + 0.1).all()


@each_refiner
def test_modes_do_not_touch_each_other_and_no_mode_is_no_work(refiner, block, pressed):
    (surface, _), (_, problem, starts) = block, pressed
    together = refiner(surface, SPREAD).refine(problem, starts)
    for i, start in enumerate(starts):
        alone = refiner(surface, SPREAD).refine(problem, start[None])
        np.testing.assert_allclose(alone.T[0], together.T[i], atol=1e-12)
    is_sound(refiner(surface, SPREAD).refine(problem, np.zeros((0, 4, 4))), 0)


@each_refiner
def test_where_the_world_has_its_origin_changes_nothing(refiner, block, pressed):
    (surface, _), (_, problem, starts) = block, pressed
    start = starts[0]
    here = refiner(surface, SPREAD).refine(problem, start[None])
    far = se3.transform(se3.exp([0.3, -0.8, 2.0, 0, 0, 0])[:3, :3], [3.0, -2.0, 1.0])
    there = refiner(surface, SPREAD).refine(Problem.joined([problem], far[None]), (far @ start)[None])
    assert here.converged[0] and there.converged[0]
    # Open3D's steps are not alike in all axes
    close = 0.05e-3 if refiner.__name__ == "Icp" else 1e-6
    assert np.abs(motion_of(here.T[0], se3.inverse(far) @ there.T[0], problem)).max() < close


@each_refiner
def test_from_free_space_nothing_converges_and_nothing_moves(refiner, block, pressed):
    (surface, _), (T, problem, _) = block, pressed
    away = np.stack([se3.transform(np.eye(3), [0, 0, z]) @ T for z in (10e-3, 0.2, -30e-3)])
    result = refiner(surface, SPREAD).refine(problem, away)
    is_sound(result, 3)
    assert not result.converged.any()
    np.testing.assert_array_equal(result.T, away)
    assert all(len(rows) == 0 for rows in result.observable)


@each_refiner
@pytest.mark.parametrize("shape", [(48, 64), (240, 320), (2, 2)])
def test_masks_without_a_rim_are_harmless(refiner, shape, block):
    surface, _ = block
    T = np.stack([facing_down(0, 0, 0.8e-3, 9e-3), facing_down(1e-3, 0, 0.3e-3, 9e-3, turn=1.0)])
    dot, corner, line = np.zeros((3, *shape), bool)
    dot[shape[0] // 2, shape[1] // 2] = corner[0, 0] = True
    line[shape[0] // 2] = True
    for mask in (np.zeros(shape, bool), np.ones(shape, bool), dot, corner, line):
        result = refiner(surface, SPREAD).refine(make_problem(mask, SENSOR), T)
        is_sound(result, 2)
        np.testing.assert_array_equal(result.T[~result.converged], T[~result.converged])


@each_refiner
def test_a_surface_in_millimetres_converges_nowhere(refiner, block, pressed):
    """Units wrong by a thousand: nothing meets, and no correspondence is reported."""
    (surface, _), (T, problem, _) = block, pressed
    wrong = Surface(1e3 * surface.points, surface.normals)
    result = refiner(wrong, SPREAD).refine(problem, T[None])
    is_sound(result, 1)
    assert not result.converged[0] and len(result.observable[0]) == 0


@each_refiner
def test_points_that_lie_on_each_other_change_nothing(refiner, block, pressed):
    (surface, _), (T, problem, starts) = block, pressed
    some = Surface(np.repeat(surface.points[:10000], 3, 0), np.repeat(surface.normals[:10000], 3, 0))
    result = refiner(some, SPREAD).refine(problem, starts[:1])
    is_sound(result, 1)
    assert result.converged[0] and told_error(result, T, result.T[0]) < told_error(result, T, starts[0])


@each_refiner
def test_a_start_that_is_no_pose_is_refused(refiner, block, pressed):
    (surface, _), (T, problem, _) = block, pressed
    for wrong in (np.nan * T, 1e3 * T):
        with pytest.raises(geomtact.GeomtactError, match="start pose"):
            refiner(surface, SPREAD).refine(problem, np.stack([T, wrong]))


# --- ray scenes

SCENES = implementations(geomtact.sensing.scene, "hits")


def rays(mesh, rng, n=400):
    """Towards points of the surface, and as many past it."""
    origin = (0.2 * se3.unit(rng.normal(size=(n, 3)))).astype(np.float32)
    aim = (mesh.sample_surface(n)[0] - origin).astype(np.float32)
    aim[n // 2 :] *= -1
    return origin, aim


@pytest.mark.parametrize("kind", SCENES, ids=lambda each: each.__name__)
def test_a_hit_lies_on_its_triangle_whichever_rays_are_cast_with_it(kind, rng):
    mesh = load_mesh("gear")
    corners = mesh.vertices[mesh.faces].astype(np.float32)
    shown = kind(corners)
    origin, aim = rays(mesh, rng)
    found, half = shown.hits(origin, aim), len(aim) // 2
    for each, dtype in ((found.t, np.float32), (found.face, np.int64)):
        assert each.shape == (len(aim),) and each.dtype == dtype
    met = found.face >= 0
    assert met[:half].mean() > 0.99 and not met[half:].any()
    assert np.isinf(found.t[~met]).all() and (found.t[met] > 0).all()
    assert np.array_equal(shown.faces(origin, aim), found.face)
    far = shown.distances(origin, aim)
    np.testing.assert_array_equal(far[met], found.t[met])
    assert (far[~met] > geomtact.sensing.scene.MISSED).all()
    a, b, c = np.moveaxis(corners[found.face[met]].astype(float), 1, 0)
    normal = se3.unit(np.cross(b - a, c - a))
    point = origin[met] + found.t[met, None] * aim[met]
    assert np.abs(((point - a) * normal).sum(1)).max() < 1e-6
    assert (se3.unit(found.normal[met].astype(float)) * normal).sum(1).min() > 0.999
    for i in (0, half - 1, half):
        alone = shown.hits(origin[i : i + 1], aim[i : i + 1])
        assert alone.face[0] == found.face[i] and alone.t[0] == found.t[i]


@pytest.mark.parametrize("name", ["pin", "gear"])
@pytest.mark.parametrize(
    "pair", list(combinations(SCENES, 2)), ids=lambda each: " and ".join(one.__name__ for one in each)
)
def test_ray_scenes_agree_with_each_other(pair, name, monkeypatch, rng):
    mesh = load_mesh(name)
    sensor = dataclasses.replace(SENSOR, image_size_px=(320, 240), pixel_pitch=(6e-5, 5e-5))
    corners = mesh.vertices[mesh.faces].astype(np.float32)
    origin, aim = rays(mesh, rng)
    one, other = (kind(corners).hits(origin, aim) for kind in pair)
    same = one.face == other.face
    assert same.mean() > 0.98  # rays along an edge
    np.testing.assert_allclose(one.t[same], other.t[same], rtol=1e-4)
    casters = []
    for kind in pair:
        monkeypatch.setattr("geomtact.sensing.cast.scene_of", lambda corners, kind=kind: kind(np.float32(corners)))
        casters.append(Caster(mesh.vertices, mesh.faces))
    T = se3.transform(se3.random_rotations(20, rng), rng.uniform(-0.01, 0.01, (20, 3)) + [0, 0, 0.02])
    mine, theirs = (caster.depths(sensor, T, (24, 32)) for caster in casters)
    both = np.isfinite(mine) & np.isfinite(theirs)
    assert (np.isfinite(mine) != np.isfinite(theirs)).mean() < 1e-3
    assert (np.abs(mine[both] - theirs[both]) > 1e-7).mean() < 1e-3
    inside = se3.transform(np.eye(3), [0, 0, -sensor.camera_distance]) @ se3.transform(
        np.eye(3), -mesh.sample_surface(1)[0][0] * 0.98
    )
    deep = [caster.penetration(sensor, inside) for caster in casters]
    assert deep[0] == pytest.approx(deep[1])
    met = [caster.faces_met(sensor, T[0], (24, 32)) for caster in casters]
    assert (met[0] == met[1]).mean() > 0.99


# --- motions

SIZES = {"radius": 8e-3, "rotation": 0.05, "translation": 1e-3}  # a motion's own fields, in radians and metres
MOTIONS = [
    each(**{field.name: SIZES[field.name] for field in dataclasses.fields(each)})
    for each in implementations(geomtact.inference, "twists")
]
KINDS = {  # an axis, a sphere, cones of approach, and a face with a housing
    "pin": ("damping_pin", "gelslim", None),
    "ball": ("ball", "gelsight-mini", None),
    "cone": ("bracket", "gelslim", [((0, 0, 1), 0.5), ((0, 0.3, 1), 0.5)]),
    "flat_nut": ("hex_nut", "gelsight-mini", [((0, 0, 1), 0.0)]),
}
each_motion = pytest.mark.parametrize("motion", MOTIONS, ids=str)


@pytest.fixture(params=slow_but(KINDS, "ball", "flat_nut"))
def grid(request, cache_dir):
    """A grid of few poses, which a motion fills in a moment."""
    name, sensor, approach = KINDS[request.param]
    return open_index(load_mesh(name), Sensor.load(sensor), approach, 6_000, cache_dir, None)


def weights(index):
    return np.asarray(index.weight).ravel().astype(float)


def dense(index, mixture):
    out = mixture.uniform * weights(index)
    np.add.at(out, mixture.cells, mixture.mass)
    return out


@each_motion
def test_a_motion_repeats_by_its_seed_and_leans_nowhere(motion):
    assert len(MOTIONS) >= 2
    mesh = load_mesh("hex_nut")
    twists, again = (motion.twists(mesh, 2000, np.random.default_rng(3)) for _ in range(2))
    assert twists.shape == (2000, 6) and np.isfinite(twists).all() and np.array_equal(twists, again)
    assert (np.abs(twists.mean(0)) < 4.5 * twists.std(0) / np.sqrt(2000)).all()
    still = dataclasses.replace(motion, **{field.name: 1e-12 for field in dataclasses.fields(motion)})
    assert np.abs(still.twists(mesh, 10, np.random.default_rng(0))).max() < 1e-8


@each_motion
def test_a_motion_keeps_the_uniform_distribution_and_all_mass(grid, motion, rng):
    spread = MotionKernel(grid, motion)
    possible = grid.possible
    after = spread(Mixture(possible, weights(grid)[possible], 0.0))
    np.testing.assert_allclose(dense(grid, after), weights(grid), rtol=2e-3, atol=1e-9)
    assert len(np.unique(after.cells)) == len(after.cells)
    cells = np.sort(rng.choice(possible, 20, replace=False))
    after = spread(Mixture(cells, rng.dirichlet(np.ones(20)), 0.0))
    assert after.mass.sum() == pytest.approx(1, abs=1e-4)
    assert after.mass.min() >= 0
    assert (weights(grid)[after.cells] > 0).all()


@each_motion
def test_components_of_a_distribution_spread_independently(grid, motion, rng):
    """However few cells hold mass: few rotations are spread by another method than all of them."""
    spread, possible = MotionKernel(grid, motion), grid.possible
    mass = weights(grid)[possible] * rng.random(len(possible))
    few = np.isin(grid.rotation[possible % grid.places], rng.choice(grid.rotation, 2))
    whole = dense(grid, spread(Mixture(possible, mass, 0.0)))
    parts = [dense(grid, spread(Mixture(possible[some], mass[some], 0.0))) for some in (few, ~few)]
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-4, atol=1e-10)


@each_motion
def test_a_motion_of_no_size_leaves_everything_where_it_was(grid, motion, rng):
    still = dataclasses.replace(motion, **{field.name: 1e-12 for field in dataclasses.fields(motion)})
    cells = np.sort(rng.choice(grid.possible, 20, replace=False))
    before = Mixture(cells, rng.dirichlet(np.ones(20)), 0.0)
    np.testing.assert_allclose(dense(grid, MotionKernel(grid, still)(before)), dense(grid, before), atol=1e-5)
