"""Several sensors' masks are resolved within the cells by the contacts of all of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest
from speed import slow_but

from geomtact import se3
from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.evaluation import simultaneous_touches
from geomtact.inference import two_runs
from geomtact.inference.effort import Effort
from geomtact.inference.gaussian_prior import GaussianPrior
from geomtact.inference.mode_mass import counted
from geomtact.inference.particles import SURE
from geomtact.inference.posterior import Posterior
from geomtact.inference.systematic_errors import ERRORS, stand_of
from geomtact.localizer import Localizer
from geomtact.scoring.contact_likelihood import mixture_weights

EFFORT = Effort(3, 80_000, thorough=False)


@pytest.fixture(scope="module")
def localizer(make_localizer):
    return make_localizer("damping_pin", "gelslim", max_poses=100_000)


def found(localizer, scene, sensors=2, effort=EFFORT, **options):
    masks = [touch.mask for touch in scene.touches[:sensors]]
    return localizer.localize(masks, "mask", None, scene.T_world_sensor[:sensors], effort=effort, **options)


@pytest.fixture(scope="module")
def scenes(localizer):
    return list(simultaneous_touches(localizer.space, 12, 2, 5))


@pytest.fixture(scope="module")
def posterior(localizer, scenes):
    some = (found(localizer, scene) for scene in scenes)
    return next(each for each in some if each.explored is not None)


@pytest.mark.parametrize("n", slow_but((4, 12), 4))
def test_they_say_more_than_the_cells(localizer, scenes, n):
    """In the mean of 12 scenes by 6 nats or more."""
    gains = [
        [found(localizer, scene, effort=effort).log_density(scene.T_world_object) for scene in scenes[:n]]
        for effort in (EFFORT, replace(EFFORT, contacts=0))
    ]
    assert np.isfinite(gains).all() and np.subtract(*gains).mean() > 1


def test_its_particles_are_distributed_as_its_density_says(posterior):
    log_density = posterior.log_density(posterior.sample(600, 0))
    assert -log_density.mean() == pytest.approx(
        posterior.entropy_nats, abs=4 * log_density.std() / np.sqrt(len(log_density)) + 0.05
    )
    assert kstest(posterior.credible_level(posterior.sample(600, 1)), "uniform").statistic < 0.08
    assert np.exp(posterior.log_prob).sum() == pytest.approx(1)


def test_its_modes_leave_room_for_what_was_missed(posterior):
    masses = np.array([mode.probability for mode in posterior.modes(20)])
    assert (np.diff(masses) <= 0).all() and masses.sum() < 1
    assert np.isfinite(posterior.log_density(np.stack([mode.T for mode in posterior.modes(3)]))).all()


def test_a_mode_holds_the_more_the_more_often_it_is_found(posterior):
    """Modes that are found once stand for as many that are missed; those that are found always hold what poses say."""
    explored = posterior.explored
    none, first = np.zeros((0, 4, 4)), np.repeat(explored.hearts[:1], 9, 0)
    once, nine, always = (
        counted(explored, none, draws, led_to).masses
        for draws, led_to in ((0.0, None), (0.0, (first, np.arange(9))), (1e12, None))
    )
    beside = 1 - 2 * once.sum()
    assert always == pytest.approx(2 * once / (1 + beside), rel=1e-6)
    assert once.max() < nine.max() < always.max()


def test_a_saved_one_is_the_same(posterior, tmp_path, localizer):
    posterior.save(tmp_path / "posterior.npz")
    again = Posterior.load(tmp_path, localizer.cache_dir)
    T = posterior.poses[:20]
    np.testing.assert_allclose(again.log_density(T), posterior.log_density(T), atol=1e-4)
    np.testing.assert_allclose(again.modes(1)[0].T, posterior.modes(1)[0].T, atol=1e-9)


def test_powers_weigh_as_for_one_contact_of_the_mean_length(posterior):
    target = posterior.explored.density.target
    queries = [target.query, target.others[0].query]
    mean = replace(queries[0], log_outline=np.log(np.mean(np.exp([query.log_outline for query in queries]))))
    np.testing.assert_allclose(target.weights, mixture_weights([mean]))


def test_poses_that_miss_a_sensor_are_possible_by_the_cells_alone(posterior):
    """Poses drawn by the first sensor alone: most miss the second one."""
    density = posterior.explored.density
    target, T = density.target, posterior.space.sample(100, np.random.default_rng(0))[0]
    at = target.particles_at(T)
    touches = np.isfinite(at.log_likelihood)
    assert at.missed[touches].mean() > 0.5
    for power, possible in ((0.0, touches), (0.5 * SURE, touches), (SURE, touches & ~at.missed)):
        assert np.array_equal(np.isfinite(at.log_target(power)), possible)
    far = T[touches & at.missed & (at.by_sensor[:, 1] == target.others[0].query.log_likelihood_of_nothing)]
    by_power = density.of_powers(far)
    assert np.isfinite(by_power[:, 0]).all() and (by_power[:, 1:] == -np.inf).any()


def test_the_mean_over_errors_is_that_over_random_ones(posterior):
    """The density at a pose averages over errors of the second contact at 256 nodes. Where hardly any of these suit, it is too
    low; hardly ever by more than 2 nats."""
    density = posterior.explored.density
    target, T = density.target, posterior.explored.poses[:20]
    k, rng, n, off = len(density.powers) - 1, np.random.default_rng(0), 4000, []
    alone = replace(density, target=replace(target, others=()))
    more = (density.of_powers(T) - alone.of_powers(T))[:, k]
    for pose, expected in zip(T, more, strict=True):
        shares = rng.random((n, ERRORS))
        likely, missed = target.others[0].log_likelihood(np.repeat(pose[None], n, 0), stand_of(shares))
        value = np.where(missed > 0, -np.inf, density.powers[k] * likely)
        mean = np.logaddexp.reduce(value) - np.log(n)
        off.append(0.0 if mean == expected else mean - expected)  # both may be of none that touches
    assert np.median(np.abs(off)) < 1 and np.quantile(np.abs(off), 0.7) < 2


def test_a_sensor_without_contact_counts_against_poses_that_touch_it(localizer, scenes, posterior):
    """The second sensor shows nothing, at a place where the poses of the first scene would touch it."""
    target = posterior.explored.density.target
    other = target.others[0]
    nothing = replace(other, query=other.query.showing(np.zeros_like(other.query.touched), localizer.sensor, "mask"))
    T = posterior.explored.poses[:50]
    right = np.broadcast_to(np.eye(4), T.shape)
    likely, missed = nothing.log_likelihood(T, right)
    assert (likely < 0).mean() > 0.5 and not missed.any()
    far = replace(nothing, T_sensor_first=se3.transform(np.eye(3), [0, 0, 2.0]))
    assert (far.log_likelihood(T, right)[0] == 0).all()


def test_the_better_sensor_poses_are_known_the_more_is_known(localizer, scenes):
    """In the mean of 4 scenes, and the uncertainty that is stated is saved."""
    gains = []
    for mm in (0.0, 1.0, 4.0):
        rig = ExtrinsicsStd(np.deg2rad(mm), mm * 1e-3)
        each = [found(localizer, scene, extrinsics_std=rig) for scene in scenes[:4]]
        assert all(p.explored is None or p.explored.density.target.others[0].extrinsics_std == rig for p in each)
        gains.append(np.mean([p.information_gain_nats for p in each]))
    assert gains[0] > gains[1] > gains[2]


def test_a_narrow_prior_adds_to_the_contacts(localizer, scenes):
    """One of 1 mm and 2 degrees about the true pose: in most cells its density is smaller than any number."""
    for scene in scenes[:2]:
        prior = GaussianPrior(scene.T_world_object, np.diag([np.deg2rad(2) ** 2] * 3 + [1e-6] * 3))
        with_prior, without = (found(localizer, scene, prior=each) for each in (prior, None))
        assert with_prior.explored is not None and np.isfinite(with_prior.log_evidence)
        gained = with_prior.log_density(scene.T_world_object) - without.log_density(scene.T_world_object)
        assert gained > 1 and with_prior.log_evidence > without.log_evidence


def test_what_leaves_contacts_unexplained_has_half_of_the_probability(localizer, scenes, monkeypatch):
    explained = found(localizer, scenes[0])
    monkeypatch.setattr(two_runs, "UNEXPLAINED_NATS", -1.0)
    unexplained = found(localizer, scenes[0])
    assert unexplained.explored.density.trust == 0.5 and explained.explored.density.trust == 1
    assert unexplained.modes(1)[0].probability < 0.6 < explained.modes(1)[0].probability
    assert any("explains all contacts: half of the probability" in warning for warning in unexplained.warnings)


@pytest.mark.slow
def test_sensors_may_differ(make_localizer, localizer, tmp_path):
    """Saved and loaded, it has the other sensor's own index."""
    both = Localizer.prepare(
        localizer.mesh, sensor=["gelslim", "digit"], max_poses=100_000, cache_dir=localizer.cache_dir
    )
    scene = next(simultaneous_touches(localizer.space, 1, 2, 5))
    digit = both.others[0]
    touch = next(iter(simultaneous_touches(digit.space, 1, 1, 3))).touches[0]
    T = [scene.T_world_sensor[0], scene.T_world_object @ se3.inverse(touch.T_sensor_object)]
    posterior = both.localize([scene.touches[0].mask, touch.mask], "mask", None, T, effort=EFFORT)
    assert posterior.log_density(scene.T_world_object) > 0
    if posterior.explored is not None:
        posterior.save(tmp_path / "posterior.npz")
        again = Posterior.load(tmp_path, localizer.cache_dir)
        assert again.explored.density.target.others[0].index.sensor.name == "digit"
