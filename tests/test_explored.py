"""Laws of a posterior that is resolved within its cells: one density, whatever is asked of it."""

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import kstest
from speed import slow_but

from geomtact import GaussianPrior, Posterior
from geomtact.contact_space.contact_maps import located
from geomtact.contact_space.touches import random_touches
from geomtact.errors import UsageError
from geomtact.evaluation import simultaneous_touches
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference import sampler, two_runs
from geomtact.inference.effort import GRID_ALONE, LEAST_CONTACTS, Effort
from geomtact.scoring.contact_likelihood import OUTLINE, POWERS, ContactQuery, mixture_weights
from geomtact.sensing.reading import read_observation

EFFORT = Effort(3, contacts=96_000)  # 10,000 at first
SCENES = {"anywhere": (None, 20_000), "on a known face": ([((0, 0, 1), 0.0)], 8_000)}  # approach and poses


@pytest.fixture(scope="module", params=slow_but(SCENES, "anywhere"))
def localizer(request, make_localizer):
    approach, max_poses = SCENES[request.param]
    return make_localizer("bracket", "gelslim", approach=approach, max_poses=max_poses)


@pytest.fixture(scope="module")
def touch(localizer):
    """It leaves enough open for uniform poses to meet its density."""
    return random_touches(localizer.space, 1, 7 if localizer.space.on_known_faces else 3)[0]


@pytest.fixture(scope="module")
def posterior(localizer, touch):
    return localizer.localize(touch.mask, "mask", effort=EFFORT)


@pytest.mark.parametrize("sensors", [1, 2, 5])
def test_attempts_grow_as_long_as_all_sensors_together_may_cut_as_many(sensors):
    for contacts in (10_000, 200_000, 800_000):
        for first in (None, 3_000):
            attempts = Effort(0, contacts, first=first).attempts(sensors)
            assert all(more == 4 * less for less, more in pairwise(attempts)) and attempts[0] == (first or attempts[0])
            assert len(attempts) == 1 or attempts[-1] * sensors <= contacts < 4 * attempts[-1] * sensors
    assert Effort(0, 10_000).attempts(1) == [10_000] and Effort(0, 10_000).attempts(2) == [2_500]
    with pytest.raises(UsageError, match="expected 1 contact or more in the first attempt, got 0"):
        Effort(0, 10_000, first=0)


def test_it_says_more_than_its_cells(localizer, touch, posterior):
    assert posterior.explored is not None
    cells = localizer.localize(touch.mask, "mask", effort=replace(EFFORT, contacts=0, modes=0))
    assert posterior.information_gain_nats > cells.information_gain_nats + 1
    assert len(posterior.poses) == len(posterior.log_prob) < len(posterior.cells)
    assert np.array_equal(posterior.cell_log_prob, cells.cell_log_prob)


def test_runs_that_agree_on_nothing_have_half_of_the_probability(localizer, touch, posterior, monkeypatch):
    """The coarse posterior has the rest: the density is at least half of its, and half of the poses come from it."""
    monkeypatch.setattr(two_runs, "_AGREE", -np.inf)
    monkeypatch.setattr(two_runs, "_AGREE_AT_LAST", -np.inf)
    found = localizer.localize(touch.mask, "mask", effort=EFFORT)
    assert "two runs of the sampler do not agree" in found.warnings[-1]
    density = found.explored.density
    assert density.trust == 0.5 and density.weights[0] >= 0.5 and density.weights.sum() == pytest.approx(1)
    assert found.explored.masses.sum() <= 1 + 1e-9 and found.diagnostics.settled_power == 0
    T = localizer.space.sample(200, np.random.default_rng(2))[0]
    coarse = density.of_powers(T)[:, 0] - density.log_inside
    assert (found.log_density(T) >= coarse + np.log(0.5) - 1e-9).all()
    assert found.information_gain_nats < posterior.information_gain_nats + 0.5


def test_two_runs_pool_what_they_found(localizer, touch):
    """The evidence is their mean, and each posterior has as many particles as both had; the weights are those of the powers that
    are kept, and the largest of them has those of the others."""
    coarse = np.exp(localizer.scorer.log_mass(localizer.index, touch.mask)).sum(0)
    query, rng = ContactQuery.of(touch.mask, localizer.sensor), np.random.default_rng(0)
    one, other = sampler.explore(localizer.index, query, coarse, 3000, rng, runs=2)
    mean = np.log(np.exp(np.array([one.log_evidence, other.log_evidence])).mean(0))
    for powers in (len(mean), 3):
        both = two_runs.pooled(one, other, powers - 1, rng)
        np.testing.assert_allclose(both.log_evidence, mean[:powers], atol=1e-9)
        assert [len(p) for p in both.particles] == [
            len(p) + len(q) for p, q in zip(one.particles[:powers], other.particles[:powers], strict=True)
        ]
        np.testing.assert_allclose(both.density.weights[:-1], mixture_weights([query])[: powers - 1])
        assert both.density.weights.sum() == pytest.approx(1)


def test_powers_on_which_runs_disagree_are_left_out(localizer, touch, monkeypatch):
    explore, seen = sampler.explore, []

    def apart(*args, **options):
        """The second run is off at all powers but the two smallest."""
        one, other = explore(*args, **options)
        seen.extend([one, other])
        off = (*other.log_evidence[:2], *(e - 50 for e in other.log_evidence[2:]))
        return one, replace(other, density=replace(other.density, log_evidence=off))

    monkeypatch.setattr(two_runs, "explore", apart)
    monkeypatch.setattr(two_runs, "_LEFT_OUT", 3)
    found = localizer.localize(touch.mask, "mask", effort=EFFORT)
    assert len(seen) == 2 and len(found.explored.density.log_evidence) == 2
    assert found.explored.contacts > sum(each.contacts for each in seen)  # of modes too
    assert found.diagnostics.settled_power == POWERS[1] / POWERS[-1] and not found.warnings
    monkeypatch.setattr(two_runs, "_LEFT_OUT", 2)
    found = localizer.localize(touch.mask, "mask", effort=replace(EFFORT, contacts=4 * LEAST_CONTACTS))
    assert len(seen) == 6 and found.explored.density.trust == 0.5


def test_its_particles_and_its_cells_have_all_mass(posterior):
    assert np.exp(posterior.log_prob).sum() == pytest.approx(1)
    assert np.exp(posterior.cell_log_prob).sum() == pytest.approx(1)


def test_the_density_is_1_in_the_mean_of_uniform_poses(localizer, posterior):
    """Within four standard errors and a fifth, of which a budget of 10,000 contacts may err."""
    poses = localizer.space.sample(2_000, np.random.default_rng(0))[0]
    density = np.exp(posterior.log_density(poses))
    assert abs(density.mean() - 1) < 4 * density.std() / np.sqrt(len(density)) + 0.2


def test_the_entropy_is_minus_the_mean_log_density_of_samples(posterior):
    log_density = posterior.log_density(posterior.sample(2000, 0))
    log_density = log_density[np.isfinite(log_density)]
    assert len(log_density) > 1980  # all but a few, which touch between the height maps' pixels alone
    error = 4 * log_density.std() / np.sqrt(len(log_density))
    assert -log_density.mean() == pytest.approx(posterior.entropy_nats, abs=error + 0.05)


def test_credible_levels_of_samples_are_uniform(posterior):
    assert kstest(posterior.credible_level(posterior.sample(1000, 1)), "uniform").statistic < 0.06


def test_a_saved_one_is_the_same(tmp_path, posterior, touch, localizer):
    posterior.save(tmp_path / "posterior.npz")
    poses = localizer.space.sample(50, np.random.default_rng(0))[0]
    for again in (Posterior.load(tmp_path, localizer.cache_dir), pickle.loads(pickle.dumps(posterior))):
        np.testing.assert_allclose(again.log_density(poses), posterior.log_density(poses), atol=1e-5)
        assert again.entropy_nats == pytest.approx(posterior.entropy_nats, abs=1e-6)
        np.testing.assert_allclose(again.modes(1)[0].T, posterior.modes(1)[0].T)
        np.testing.assert_allclose(again.modes(1)[0].covariance, posterior.modes(1)[0].covariance, rtol=1e-6)


def test_registration_moves_a_mode_within_its_radius(posterior):
    first = posterior.modes(1)[0]
    plain = replace(posterior, refined={}).modes(1)[0]
    assert posterior.log_density(first.T) >= posterior.log_density(plain.T) - 1e-3
    assert PoseDistance(posterior.mesh).mean(plain.T, first.T[None])[0] <= mode_radius(posterior.mesh)
    assert (np.linalg.eigvalsh(first.covariance) > 0).all()


@pytest.mark.parametrize("excess, trust", [(0.5, 1.0), (5.0, 0.5)])
def test_modes_that_hold_more_than_everything_raise_the_evidence(localizer, touch, monkeypatch, excess, trust):
    """By as much; where that is more than runs may differ by, what they found has half of the probability alone."""
    drawn = []

    def weighed(found, *_):
        drawn.append(found)
        return found, excess

    monkeypatch.setattr(two_runs, "weighed", weighed)
    found = localizer.localize(touch.mask, "mask", effort=EFFORT)
    own, before = found.explored.density, drawn[-1].density
    assert own.trust == trust and ("do not agree" in " ".join(found.warnings)) == (trust < 1)
    np.testing.assert_allclose(
        np.subtract(own.log_evidence, before.log_evidence), [0.0] + [excess] * (len(own.powers) - 1)
    )
    np.testing.assert_allclose(found.explored.log_density, own.log_density(found.explored.poses), atol=1e-6)


def test_modes_share_the_mass_out(posterior):
    modes = posterior.modes(8)
    each = [mode.probability for mode in modes]
    assert sum(each) <= 1 + 1e-9 and each == sorted(each, reverse=True)


def test_the_likeliest_poses_are_the_densest(posterior):
    log_density = posterior.log_density(posterior.likeliest(5))
    assert (np.diff(log_density) < 1e-3).all()
    assert log_density[0] == pytest.approx(posterior.explored.log_density.max(), abs=1e-2)


def test_a_prior_counts_once(localizer, touch, posterior):
    """What is made e times as probable is so after it: by the densities of the same poses, whatever the sampler found."""
    left = localizer.index.poses()[:, 0, 3] < 0
    known = localizer.localize(touch.mask, "mask", effort=EFFORT, prior=lambda T: np.where(T[:, 0, 3] < 0, 1.0, 0.0))
    poses = localizer.space.sample(400, np.random.default_rng(0))[0]
    cell = localizer.index.lookup(poses, localizer.space.penetration(poses))
    change = known.log_density(poses) - posterior.log_density(poses)
    assert np.std(change[left[cell]]) < 0.6 and np.median(change[left[cell]]) - np.median(
        change[~left[cell]]
    ) == pytest.approx(1, abs=0.35)


def test_a_narrow_prior_is_resolved_alike_by_any_seed(localizer, touch):
    """A first attempt with the least contacts may miss what is left of it, in both of its runs."""
    near = GaussianPrior(touch.T_sensor_object, np.diag([0.02] * 3 + [1e-3] * 3) ** 2)
    effort = replace(EFFORT, contacts=4 * EFFORT.contacts)
    found = [localizer.localize(touch.mask, "mask", effort=effort, prior=near, seed=seed) for seed in (0, 1)]
    evidence = [each.explored.density.log_evidence for each in found]
    powers = min(map(len, evidence))
    one, other = (np.array(each[:powers]) for each in evidence)
    assert powers > 2 and one == pytest.approx(other, abs=2)


def test_what_a_prior_rules_out_stays_so(localizer, touch):
    known = localizer.localize(
        touch.mask, "mask", effort=EFFORT, prior=lambda T: np.where(T[:, 0, 3] < 0, 0.0, -np.inf)
    )
    ruled_out = localizer.index.poses()[:, 0, 3] >= 0
    assert not np.exp(known.cell_log_prob)[ruled_out[known.cells]].any()
    explored, index = known.explored, localizer.index
    poses, _ = located(index, explored.poses)
    assert np.isfinite(explored.density.target.prior.log_density(poses, explored.depth)).all()


def test_the_same_seed_gives_the_same(localizer, touch, posterior):
    again = localizer.localize(touch.mask, "mask", effort=EFFORT)
    np.testing.assert_array_equal(again.poses, posterior.poses)
    other = localizer.localize(touch.mask, "mask", effort=EFFORT, seed=1)
    assert other.information_gain_nats == pytest.approx(posterior.information_gain_nats, abs=1.5)


def test_it_serves_as_a_prior(localizer, touch, posterior):
    """As its cells do."""
    cells = replace(posterior, explored=None, refined={})
    one, other = (localizer.localize(touch.mask, "mask", effort=Effort(0), prior=each) for each in (posterior, cells))
    np.testing.assert_allclose(one.log_prob, other.log_prob, atol=1e-5)


def test_a_contact_found_in_an_image_is_trusted_less(localizer, touch, posterior, tmp_path):
    """Than the same one given as a mask: by smaller powers of its likelihood; also when it comes back from a file."""
    read = read_observation(touch.mask, localizer.sensor, "mask")
    found = localizer.localize(replace(read, kind="reading", method="network"), effort=EFFORT)
    assert found.explored.density.target.query.source == "image"
    assert posterior.explored.density.target.query.source == "mask"
    for log_outline in np.log(np.geomspace(5e-3, 100e-3, 20) / OUTLINE):
        image, mask = (
            mixture_weights([replace(query, log_outline=log_outline)])
            for query in (found.explored.density.target.query, posterior.explored.density.target.query)
        )
        assert image @ POWERS < mask @ POWERS
    found.save(tmp_path / "posterior.npz")
    np.testing.assert_array_equal(Posterior.load(tmp_path, localizer.cache_dir).log_prob, found.log_prob)


def test_several_sensors_stay_on_the_cells_where_no_contacts_are_given(localizer):
    scene = next(simultaneous_touches(localizer.space, 1, 2, seed=0))
    masks = [each.mask for each in scene.touches]
    assert localizer.localize(masks, "mask", None, scene.T_world_sensor, effort=GRID_ALONE).explored is None
