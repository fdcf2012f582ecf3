"""Laws of the posterior: a normalised density over the contact pose space, the same in every frame and on disk."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from speed import slow_but

from geomtact.contact_space.draw import draw_within
from geomtact.errors import InputError, PoseError, UsageError
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference.distribution import cell_log_density, row_poses
from geomtact.inference.effort import GRID_ALONE
from geomtact.inference.posterior import Posterior
from geomtact.se3 import exp, transform

T_WORLD = exp([0.3, -1.2, 0.5, 0.4, -0.1, 0.7])
MM = 1e-3


@pytest.fixture(scope="module")
def posteriors(a_touch):
    """The posterior of one touch of a localizer, by its cells, without refinement."""
    found: dict[str, Posterior] = {}

    def of(localizer) -> Posterior:
        key = localizer.index.key
        if key not in found:
            found[key] = localizer.localize(a_touch(localizer)[1], effort=GRID_ALONE)
        return found[key]

    return of


@pytest.fixture(scope="module")
def samples(posteriors):
    """Draws (300, 4, 4) from that posterior."""
    drawn = {}

    def of(localizer):
        key = localizer.index.key
        if key not in drawn:
            drawn[key] = posteriors(localizer).sample(300, np.random.default_rng(3))
        return drawn[key]

    return of


def measure(posterior):
    """Share (N,) of the uniform measure in each of its cells."""
    return np.asarray(posterior.index.weight, float).ravel()[posterior.cells]


def test_probabilities_are_a_distribution(localizer, posteriors):
    posterior = posteriors(localizer)
    assert np.exp(posterior.log_prob).sum() == pytest.approx(1, abs=1e-5)
    assert posterior.poses.shape == (len(posterior.log_prob), 4, 4)
    assert posterior.contact and posterior.frame == "sensor"
    assert (np.diff(posterior.cells) > 0).all()
    assert 1 <= posterior.effective_poses <= len(posterior.index)


def test_entropy_is_minus_the_mean_log_density(localizer, posteriors, samples):
    """By its definition as a sum over cells, and over poses drawn from the posterior."""
    posterior = posteriors(localizer)
    w = measure(posterior)
    p = np.exp(posterior.log_prob)
    assert posterior.entropy_nats == pytest.approx(-(p * (posterior.log_prob - np.log(w))).sum(), abs=1e-5)
    assert posterior.entropy_nats < 0
    density = posterior.log_density(samples(localizer))
    inside = np.isfinite(density)
    assert inside.mean() > 0.97, "all but the cells that no draw could be found in"
    error = density[inside].std() / np.sqrt(inside.sum())
    assert -density[inside].mean() == pytest.approx(posterior.entropy_nats, abs=4 * error + 0.05)


def test_information_gain_is_minus_entropy(localizer, posteriors):
    posterior = posteriors(localizer)
    assert posterior.information_gain_nats == -posterior.entropy_nats != 0
    assert replace(posterior, contact=False).information_gain_nats == 0


def test_the_density_integrates_to_one(localizer, posteriors, uniform_poses):
    """Its mean over poses drawn uniformly, without the index, is 1 within its standard error and the grid's coarseness."""
    posterior = posteriors(localizer)
    # flattened, so that two hundred poses are enough: a mixture with the uniform of the posterior's square root
    w = measure(posterior)
    p = np.exp(0.25 * posterior.log_prob + 0.75 * np.log(w))
    flat = replace(posterior, cell_log_prob=np.log(p / p.sum()))
    density = np.exp(flat.log_density(uniform_poses(localizer)[0]))
    error = density.std() / np.sqrt(len(density))
    assert density.mean() == pytest.approx(1, abs=4 * error + 0.06)


def test_the_uniform_scores_0_everywhere(localizer, posteriors, uniform_poses):
    index = localizer.index
    w = np.asarray(index.weight, float).ravel()
    cells = np.flatnonzero(w)
    uniform = replace(posteriors(localizer), cells=cells, cell_log_prob=np.log(w[cells] / w.sum()))
    assert np.abs(uniform.log_density(uniform_poses(localizer)[0])).max() < 1e-5
    assert uniform.entropy_nats == pytest.approx(0, abs=1e-5)
    assert uniform.effective_poses == pytest.approx(len(index), rel=1e-4)


def test_log_density_is_finite_exactly_on_the_contact_pose_space(localizer, posteriors, uniform_poses, rng):
    posterior = posteriors(localizer)
    T, _ = uniform_poses(localizer)
    assert np.isfinite(posterior.log_density(T)).all()
    moved = T.copy()  # by so much that some of them no longer touch, or press too deep
    moved[:, 2, 3] += rng.uniform(-2 * MM, 2 * MM, len(T))
    pressed = localizer.space.caster.penetration(localizer.sensor, moved)
    touching = (pressed >= 0) & (pressed <= localizer.sensor.max_penetration)
    if localizer.sensor.housing_depth is not None:
        lowest = localizer.space.caster.lowest_outside(localizer.sensor, moved)
        touching &= lowest >= -localizer.sensor.housing_depth
    assert 0.05 < touching.mean() < 0.95
    clear = np.minimum(np.abs(pressed), np.abs(pressed - localizer.sensor.max_penetration)) > 1e-6
    assert (np.isfinite(posterior.log_density(moved)) == touching)[clear].all()
    away = T.copy()
    away[:, 2, 3] += 1
    assert (posterior.log_density(away) == -np.inf).all()
    assert isinstance(posterior.log_density(T[0]), float)
    assert posterior.log_density(T[:6].reshape(2, 3, 4, 4)).shape == (2, 3)
    assert (posterior.log_density(T[:6].reshape(2, 3, 4, 4)).ravel() == posterior.log_density(T[:6])).all()


def test_density_and_level_do_not_change_under_the_objects_symmetry(localizer, posteriors, samples, rng):
    posterior, symmetry = posteriors(localizer), localizer.mesh.symmetry
    T = samples(localizer)[:100]
    S = symmetry.sampled(36)[rng.integers(len(symmetry.sampled(36)), size=100)]
    image = T @ S
    allowed = localizer.space.approaches(image)
    # a continuous symmetry is one of the ideal body, of which the mesh is a polyhedron: a pose may change its depth
    here, there = posterior.log_density(T)[allowed], posterior.log_density(image)[allowed]
    assert len(here) > 5
    assert (np.abs(here - there) < 1e-9).mean() > 0.95
    assert (posterior.log_density(image)[~allowed] == -np.inf).all()


def test_the_density_of_a_cell_is_its_mass_over_its_measure(localizer, posteriors, rng):
    posterior, index = posteriors(localizer), localizer.index
    rows = rng.choice(len(posterior.cells), 40)
    rows[:10] = np.argsort(-posterior.log_prob)[:10]
    T, _, found = draw_within(index, localizer.space, posterior.cells[rows], rng)
    w = measure(posterior)[rows]
    expected = posterior.log_prob[rows] - np.log(w)
    agree = np.abs(posterior.log_density(T[found]) - expected[found]) < 1e-5
    assert agree.mean() > 0.95
    ids = np.setdiff1d(np.arange(len(index)), posterior.cells)[:5]
    assert (cell_log_density(posterior, ids) == -np.inf).all()


# --- credible levels


def test_levels_of_draws_are_uniform(localizer, posteriors, samples):
    posterior = posteriors(localizer)
    T = samples(localizer)
    level = posterior.credible_level(T)
    assert ((level >= 0) & (level <= 1)).all()
    inside = np.isfinite(posterior.log_density(T))
    assert kstest(level[inside], "uniform").pvalue > 1e-3


def test_levels_are_repeatable_and_depend_on_the_seed(plug, posteriors, samples):
    posterior, T = posteriors(plug), samples(plug)[:20]
    level = posterior.credible_level(T)
    assert (level == posterior.credible_level(T)).all()
    assert (level == replace(posterior).credible_level(T)).all()
    assert (level == [posterior.credible_level(pose) for pose in T]).all()
    assert (level != replace(posterior, seed=1).credible_level(T)).all()


def test_the_credible_level_is_the_mass_of_denser_poses(localizer, posteriors, samples):
    posterior = posteriors(localizer)
    w = measure(posterior)
    p = np.exp(posterior.log_prob)
    T = samples(localizer)[:40]
    for rho, level in zip(posterior.log_density(T), posterior.credible_level(T), strict=True):
        if np.isfinite(rho):
            density = np.log(p / w)
            assert p[density > rho + 1e-6].sum() - 1e-5 <= level <= p[density > rho - 1e-6].sum() + 1e-5


def test_off_the_space_the_level_is_1(plug, posteriors):
    assert posteriors(plug).credible_level(transform(np.eye(3), [0, 0, 1])) == 1


# --- modes


def modes_by_brute_force(posterior, modes):
    """The mass within reach of each mode, each pose counted for the most probable mode only."""
    distance, radius = PoseDistance(posterior.mesh, 128), mode_radius(posterior.mesh)
    left, out = np.exp(posterior.log_prob), []
    poses = posterior.poses
    for mode in modes:
        near = distance.mean(mode.T, poses) <= radius
        out.append(left[near].sum())
        left[near] = 0
    return out


def test_a_mode_holds_the_mass_within_its_radius(localizer, posteriors):
    posterior = posteriors(localizer)
    modes = posterior.modes(5)
    assert modes and all(m.probability > 0 for m in modes)
    probability = [m.probability for m in modes]
    assert probability == sorted(probability, reverse=True) and sum(probability) <= 1 + 1e-6
    assert probability == pytest.approx(modes_by_brute_force(posterior, modes), abs=1e-6)
    distance, radius = PoseDistance(posterior.mesh, 128), mode_radius(posterior.mesh)
    for i, mode in enumerate(modes):
        assert mode.covariance.shape == (6, 6) and mode.observable.shape[1:] == (6,)
        assert np.abs(mode.covariance - mode.covariance.T).max() < 1e-9
        assert np.linalg.eigvalsh(mode.covariance).min() > -1e-12
        rows = mode.observable
        assert np.abs(rows @ rows.T - np.eye(len(rows))).max(initial=0) < 1e-6
        others = np.stack([m.T for m in modes[:i]]) if i else np.zeros((0, 4, 4))
        assert (distance.mean(mode.T, others) > radius).all()
    assert len(posterior.modes(2)) <= 2 and posterior.modes(0) == []
    assert [m.probability for m in posterior.modes(2)] == probability[:2]


def test_modes_of_a_ball_are_positions(ball, posteriors, a_touch):
    """All rotations of a ball are one pose."""
    posterior = posteriors(ball)
    T, _ = a_touch(ball)
    modes = posterior.modes(5)
    centres = np.array([m.T[:3, 3] for m in modes])
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + np.eye(len(modes))
    assert apart.min() > mode_radius(ball.mesh)
    turned = T @ transform(Rotation.random(random_state=0).as_matrix(), np.zeros(3))
    assert posterior.log_density(T) == pytest.approx(posterior.log_density(turned), abs=1e-9)
    assert modes[0].probability > 0.1
    assert np.linalg.norm(modes[0].T[:2, 3] - T[:2, 3]) < 1 * MM


def test_modes_are_allowed_poses(localizer, posteriors):
    posterior = posteriors(localizer)
    T = np.stack([m.T for m in posterior.modes(5)])
    assert localizer.space.approaches(T).all()
    assert np.isfinite(localizer.space.caster.penetration(localizer.sensor, T)).all()


def test_the_likeliest_poses_are_those_of_the_cells_with_most_mass(localizer, a_touch):
    posterior = localizer.localize(a_touch(localizer)[1], T_world_sensor=T_WORLD, effort=GRID_ALONE)
    mass = posterior.log_prob
    poses = posterior.likeliest(10)
    row = [int(np.abs(posterior.poses - T).max((1, 2)).argmin()) for T in poses]
    assert poses == pytest.approx(posterior.poses[row], abs=1e-12) and len(set(row)) == len(row) == min(10, len(mass))
    assert (np.diff(mass[row]) <= 1e-6).all() and mass[row].min() >= np.delete(mass, row).max(initial=-np.inf) - 1e-6
    assert len(posterior.likeliest(10**7)) == (posterior.log_prob > -np.inf).sum()
    assert posterior.likeliest(0).shape == (0, 4, 4)


def test_modes_returns_as_many_as_asked_for_in_any_order_of_cells(plug, posteriors):
    """Also where the very likeliest are every fiftieth, by which the rest is sifted."""
    posterior = posteriors(plug)
    plain = replace(posterior, cells=posterior.index.possible, cell_log_prob=np.zeros(len(posterior.index.possible)))
    for seed in range(20):
        mass = np.random.default_rng(seed).normal(size=len(plain.cells))
        mass[::50] += 5 * (seed % 2)
        poses = replace(plain, cell_log_prob=mass).likeliest(7)
        assert np.array_equal(poses, row_poses(plain, np.argsort(-mass)[:7]))


# --- samples


def test_samples_follow_the_probabilities_of_the_cells(localizer, posteriors, samples):
    """Also those of cells on the border of the space: grouped by share, samples come as often as their mass."""
    posterior, index = posteriors(localizer), localizer.index
    T = samples(localizer)
    depth = localizer.space.penetration(T)
    inside = np.isfinite(depth)
    cell = index.lookup(T[inside], depth[inside])
    p = np.exp(posterior.log_prob)
    order = np.argsort(-p)
    groups = defaultdict(float)
    group = np.zeros(len(p), int)
    group[order] = np.minimum((np.cumsum(p[order]) * 5).astype(int), 4)
    for g, mass in zip(group, p, strict=True):
        groups[g] += mass
    group_of = np.zeros(len(index), int)
    group_of[posterior.cells] = group
    n = inside.sum()
    for g, mass in groups.items():
        got = (group_of[cell] == g).sum()
        assert abs(got - n * mass) < 5 * np.sqrt(n * mass) + 0.03 * n


def test_samples_are_spread_over_the_objects_symmetry(ball, flat_nut, samples):
    R = samples(ball)[:, :3, :3]
    assert np.linalg.norm(R.mean(0)) < 0.3, "a ball has every rotation"
    turn = np.arctan2(*np.moveaxis(samples(flat_nut)[:, [1, 0], 0], -1, 0))
    sixths = np.bincount(((turn % (2 * np.pi)) // (np.pi / 3)).astype(int), minlength=6)
    assert sixths.min() > 300 / 6 / 2, "a nut has six turns"


def test_samples_are_the_same_for_the_same_seed(plug, posteriors):
    one, other = (posteriors(plug).sample(10, np.random.default_rng(4)) for _ in range(2))
    assert one.shape == (10, 4, 4) and (one == other).all()


# --- frames


def test_the_world_frame_moves_everything_and_changes_nothing(plug, a_touch, samples):
    T, mask = a_touch(plug)
    here = plug.localize(mask)
    there = plug.localize(mask, T_world_sensor=T_WORLD)
    in_list = plug.localize([mask], T_world_sensor=[T_WORLD])
    assert (here.frame, there.frame, in_list.frame) == ("sensor", "world", "world")
    draws = np.concatenate([T[None], samples(plug)[:30]])
    assert np.array_equal(there.log_density(T_WORLD @ draws), here.log_density(draws))
    assert np.array_equal(in_list.log_density(T_WORLD @ draws), here.log_density(draws))
    assert np.abs(there.poses - T_WORLD @ here.poses).max() < 1e-12
    assert there.entropy_nats == here.entropy_nats and (there.log_prob == here.log_prob).all()
    for a, b in zip(here.modes(), there.modes(), strict=True):
        assert np.abs(b.T - T_WORLD @ a.T).max() < 1e-12
        assert b.probability == a.probability
        # the twist is in the object's frame
        assert b.covariance == pytest.approx(a.covariance, rel=1e-9, abs=1e-15)
    sample = there.sample(5, np.random.default_rng(0))
    assert np.abs(sample - T_WORLD @ here.sample(5, np.random.default_rng(0))).max() < 1e-12


def test_what_is_no_pose_is_refused(plug, posteriors):
    for bad in (np.eye(3), np.full((4, 4), np.nan), np.diag([2.0, 1, 1, 1])):
        for method in (posteriors(plug).log_density, posteriors(plug).credible_level):
            with pytest.raises(PoseError):
                method(bad)


# --- no contact


def test_an_image_without_contact_gives_a_posterior_without_contact(plug, uniform_poses, rng):
    posterior = plug.localize(np.zeros(plug.sensor.image_size_px[::-1], bool))
    T, _ = uniform_poses(plug)
    assert posterior.contact is False
    assert posterior.modes() == [] and posterior.poses.shape == (0, 4, 4) and posterior.log_prob.shape == (0,)
    assert (posterior.log_density(T) == -np.inf).all()
    away = T.copy()
    away[:, 2, 3] += 1
    assert (posterior.log_density(away) == 0).all()
    assert posterior.entropy_nats == 0
    assert posterior.effective_poses == 0
    assert posterior.credible_level(T[0]) == 1
    with pytest.raises(UsageError, match="no contact"):
        posterior.sample(3, rng)


def test_a_seed_draws_the_samples_of_its_generator(plug, posteriors):
    posterior = posteriors(plug)
    for seed in (7, np.int64(7)):
        assert np.array_equal(posterior.sample(20, seed), posterior.sample(20, np.random.default_rng(7)))
    with pytest.raises(UsageError, match="expected a generator or a seed, got None"):
        posterior.sample(20, None)


# --- on disk


@pytest.mark.parametrize("name", slow_but(["plug", "ball", "flat_nut", "cone"], "plug", "flat_nut"))
def test_a_posterior_survives_the_disk(name, request, a_touch, samples, cache_dir, tmp_path):
    localizer = request.getfixturevalue(name)
    T, mask = a_touch(localizer)
    posterior = localizer.localize(mask, T_world_sensor=T_WORLD, seed=11)
    posterior.save(tmp_path / "posterior.npz")
    again = Posterior.load(tmp_path / "posterior.npz", cache_dir)
    assert again.frame == "world" and again.seed == 11 and again.contact
    assert again.index.key == posterior.index.key
    assert again.mesh.sha256 == posterior.mesh.sha256 and again.sensor == posterior.sensor
    draws = T_WORLD @ np.concatenate([T[None], samples(localizer)[:50]])
    assert np.array_equal(again.log_density(draws), posterior.log_density(draws))
    assert again.entropy_nats == posterior.entropy_nats
    assert again.log_evidence == posterior.log_evidence
    assert again.settings == posterior.settings and again.diagnostics == posterior.diagnostics
    assert np.array_equal(again.credible_level(draws), posterior.credible_level(draws))  # ties, too
    for a, b in zip(posterior.modes(), again.modes(), strict=True):
        assert np.abs(a.T - b.T).max() < 1e-9 and b.probability == pytest.approx(a.probability, abs=1e-5)
        assert np.array_equal(a.covariance, b.covariance) and np.array_equal(a.observable, b.observable)
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.npz"]
    folder = Posterior.load(tmp_path, cache_dir)
    assert np.array_equal(folder.log_prob, again.log_prob) and np.array_equal(folder.cells, again.cells)


def test_the_file_holds_the_promised_arrays_and_no_pickles(plug, posteriors, tmp_path):
    posterior = posteriors(plug)
    posterior.save(tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz", allow_pickle=False) as file:
        data = {k: file[k] for k in file.files}
    assert {"poses", "log_prob", "frame", "object_sha256", "sensor_toml", "seed"} <= set(data)
    assert data["poses"].shape == (len(data["log_prob"]), 4, 4)
    assert np.exp(data["log_prob"]).sum() == pytest.approx(1, abs=1e-5)
    assert str(data["frame"]) == "sensor" and str(data["object_sha256"]) == plug.mesh.sha256


@pytest.mark.parametrize(
    ("name", "spoil", "expected"),
    [
        ("T_frame_sensor", lambda T: 2 * T, "no rotation"),
        ("T_frame_sensor", lambda T: T * np.nan, "finite"),
        ("row_log_prob", lambda p: p + 5, "probabilities that add up to 148"),
        ("row_log_prob", lambda p: p[:-1], "rows of different length"),
        ("row_cell", lambda cells: cells + 10**9, "cells that are not of its grid"),
        ("row_cell", lambda cells: cells[::-1], "cells that are not of its grid"),
        ("vertices", lambda vertices: 1.5 * vertices, "not the one that its checksum names"),
        ("frame", lambda frame: np.array("camera"), "frame 'camera'"),
    ],
)
def test_a_file_whose_numbers_make_no_posterior_is_refused(
    plug, posteriors, tmp_path, cache_dir, name, spoil, expected
):
    posteriors(plug).save(tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz", allow_pickle=False) as file:
        data = {k: file[k] for k in file.files}
    np.savez(tmp_path / "spoilt.npz", **data | {name: spoil(data[name])})
    with pytest.raises(InputError, match=f"spoilt.npz: not a posterior that geomtact saved .*{expected}"):
        Posterior.load(tmp_path / "spoilt.npz", cache_dir)


def test_no_contact_survives_the_disk(plug, tmp_path, cache_dir):
    plug.localize(np.zeros(plug.sensor.image_size_px[::-1], bool)).save(tmp_path / "p.npz")
    again = Posterior.load(tmp_path / "p.npz", cache_dir)
    assert again.contact is False and again.modes() == [] and again.poses.shape == (0, 4, 4) and not again.warnings


def test_a_file_without_contact_is_refused_as_a_prior(plug, tmp_path, cache_dir):
    nothing = np.zeros(plug.sensor.image_size_px[::-1], bool)
    plug.localize(nothing, prior=lambda T: np.where(T[:, 0, 3] > 0, 0.0, -3.0)).save(tmp_path / "p.npz")
    again = Posterior.load(tmp_path / "p.npz", cache_dir)
    assert [warning for warning in again.warnings if "prior" in warning] == again.warnings != []


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 truncated"])
def test_what_is_no_posterior_is_refused(tmp_path, content):
    path = tmp_path / "p.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a posterior that geomtact saved") as error:
        Posterior.load(path)
    assert "\n" not in str(error.value)
    for nowhere in (tmp_path / "nowhere.npz", tmp_path):
        with pytest.raises(
            InputError, match="(no such file|no posterior.npz in that folder); give a posterior.npz, or its folder"
        ):
            Posterior.load(nowhere)


def test_a_truncated_posterior_is_refused(plug, posteriors, tmp_path):
    posteriors(plug).save(tmp_path / "p.npz")
    whole = (tmp_path / "p.npz").read_bytes()
    (tmp_path / "p.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="not a posterior that geomtact saved"):
        Posterior.load(tmp_path / "p.npz")


def test_a_file_that_cannot_be_written_is_named_as_it_was_given(plug, posteriors, tmp_path):
    for path in (tmp_path, tmp_path / "none" / "p.npz"):
        with pytest.raises(InputError, match=f"^{path}: cannot be written"):
            posteriors(plug).save(path)
    assert list(tmp_path.iterdir()) == []
