"""One touch, from image to distribution: laws that hold for every part, sensor and approach."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import kstest

from geomtact import GeomtactError, Posterior, se3
from geomtact.evaluation.touches import random_touches
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.sensing.noise import MODERATE


@pytest.fixture
def touch(localizer):
    return random_touches(localizer, 1, seed=3, noise=MODERATE)[0]


@pytest.fixture
def posterior(localizer, touch):
    return localizer.localize(touch.mask, kind="mask", effort="fast")


def test_a_posterior_is_normalised_and_knows_what_it_knows(localizer, posterior):
    assert logsumexp(posterior.log_prob) == pytest.approx(0, abs=1e-6)
    assert posterior.poses.shape == (len(posterior.log_prob), 4, 4)
    drawn = posterior.log_density(posterior.sample(300, np.random.default_rng(0)))
    assert np.isfinite(drawn).all()
    assert drawn.mean() == pytest.approx(-posterior.entropy_nats, abs=4 * drawn.std() / np.sqrt(300) + 0.05)


def test_the_density_is_relative_to_the_uniform_distribution(posterior, localizer, uniform_poses):
    # cut off at 8, so that a sharp posterior is judged by more than its few densest cells
    over_poses = np.minimum(np.exp(posterior.log_density(uniform_poses(localizer)[0])), 8)
    weight = localizer.index.weight.ravel().astype(float)
    density = np.minimum(np.exp(posterior.cell_log_density(np.arange(len(weight)))), 8)
    error = np.sqrt(weight @ (density - weight @ density) ** 2 / len(over_poses))
    assert over_poses.mean() == pytest.approx(weight @ density, abs=4 * error)


def test_credible_levels_of_its_own_samples_are_uniform_and_repeatable(posterior):
    T = posterior.sample(200, np.random.default_rng(1))
    level = posterior.credible_level(T)
    assert kstest(level, "uniform").pvalue > 1e-3
    assert (posterior.credible_level(T) == level).all()


def test_the_density_ends_where_contact_does(posterior, touch):
    lifted, pressed = touch.T_sensor_object.copy(), touch.T_sensor_object.copy()
    lifted[2, 3] += 5e-3
    pressed[2, 3] -= 5e-3
    assert posterior.log_density(lifted) == -np.inf
    assert posterior.log_density(pressed) == -np.inf
    assert posterior.credible_level(lifted) == 1
    assert np.isfinite(posterior.log_density(touch.T_sensor_object))


def test_symmetric_poses_are_one(posterior, touch, localizer):
    images = touch.T_sensor_object @ localizer.mesh.symmetry.sampled(6)
    allowed = np.isfinite(localizer.space.penetration(images))
    density = posterior.log_density(images[allowed])
    assert np.ptp(density) < 1e-9


def test_a_mode_holds_the_mass_around_it_and_no_pose_counts_twice(posterior, localizer):
    modes = posterior.modes(4)
    probability = [mode.probability for mode in modes]
    assert probability == sorted(probability, reverse=True)
    distance, radius = PoseDistance(localizer.mesh, 128), mode_radius(localizer.mesh)
    p, taken = np.exp(posterior.log_prob), np.zeros(len(posterior.log_prob), bool)
    for mode in modes[:2]:
        near = distance.mean(mode.T, posterior.poses) <= radius
        assert mode.probability == pytest.approx(p[near & ~taken].sum(), rel=1e-6)
        taken |= near
    for mode in modes:
        assert np.linalg.eigvalsh(mode.covariance).min() > -1e-15
        assert mode.observable @ mode.observable.T == pytest.approx(np.eye(len(mode.observable)), abs=1e-9)


def test_a_saved_posterior_comes_back(posterior, touch, tmp_path, cache_dir):
    posterior.save(tmp_path / "posterior.npz")
    loaded = Posterior.load(tmp_path / "posterior.npz", cache_dir=cache_dir)
    T = posterior.sample(20, np.random.default_rng(2))
    assert loaded.log_density(T) == pytest.approx(posterior.log_density(T), abs=1e-4)
    assert loaded.entropy_nats == pytest.approx(posterior.entropy_nats, abs=1e-4)
    assert [m.probability for m in loaded.modes(3)] == pytest.approx(
        [m.probability for m in posterior.modes(3)], rel=1e-3
    )
    with np.load(tmp_path / "posterior.npz", allow_pickle=False) as file:
        assert {"poses", "log_prob", "frame", "object_sha256", "sensor_toml", "seed"} <= set(file.files)
        assert str(file["object_sha256"]) == posterior.mesh.sha256
        assert logsumexp(file["log_prob"]) == pytest.approx(0, abs=1e-9)


def test_the_world_frame_moves_everything_with_the_sensor(plug):
    touch = random_touches(plug, 1, seed=4)[0]
    T_world_sensor = se3.exp(np.array([0.3, -1.1, 2.0, 0.1, -0.2, 0.5]))
    here = plug.localize(touch.mask, kind="mask")
    there = plug.localize(touch.mask, kind="mask", T_world_sensor=T_world_sensor)
    assert (here.frame, there.frame) == ("sensor", "world")
    for a, b in zip(here.modes(3), there.modes(3), strict=True):
        assert pytest.approx(T_world_sensor @ a.T, abs=1e-12) == b.T
        assert b.probability == a.probability
    T = touch.T_sensor_object
    assert there.log_density(T_world_sensor @ T) == pytest.approx(here.log_density(T), abs=1e-9)


def test_no_contact_is_an_answer(plug, uniform_poses):
    posterior = plug.localize(np.zeros(plug.sensor.image_size_px[::-1], bool))
    assert not posterior.contact
    assert posterior.modes() == []
    assert posterior.poses.shape == (0, 4, 4)
    T = uniform_poses(plug)[0][0]
    assert posterior.log_density(T) == -np.inf
    T = T.copy()
    T[2, 3] += 0.05
    assert posterior.log_density(T) == 0
    with pytest.raises(GeomtactError, match="no contact"):
        posterior.sample(1, np.random.default_rng(0))


def test_priors(plug, tmp_path, cache_dir):
    touch = random_touches(plug, 1, seed=5)[0]
    plain = plug.localize(touch.mask, kind="mask", effort="fast")

    def log_prob(prior):
        return plug.localize(touch.mask, kind="mask", effort="fast", prior=prior).log_prob

    flat = log_prob(lambda T: np.full(len(T), 7.0))
    assert flat == pytest.approx(plain.log_prob, abs=1e-4)
    # the floor is a share of the prior, so the pose of a sharp prior is the posterior's too
    sharp = plug.localize(touch.mask, kind="mask", effort="fast", prior=(touch.T_sensor_object[None], [0.0]))
    assert sharp.log_density(touch.T_sensor_object) > plain.log_density(touch.T_sensor_object) + 2
    assert np.exp(sharp.log_prob).max() == pytest.approx(1)
    plain.save(tmp_path / "prior.npz")
    twice = log_prob(plain)
    assert twice == pytest.approx(log_prob(Posterior.load(tmp_path / "prior.npz", cache_dir)), abs=1e-3)
    assert -(np.exp(twice) @ twice) < -(np.exp(plain.log_prob) @ plain.log_prob)
    with pytest.raises(GeomtactError, match="rules out every pose"):
        log_prob(lambda T: np.full(len(T), -np.inf))
    with pytest.raises(GeomtactError, match="expected a Posterior"):
        log_prob(3)


def test_the_same_touch_gives_the_same_answer(plug):
    mask = random_touches(plug, 1, seed=6)[0].mask
    a, b = (plug.localize(mask, kind="mask") for _ in range(2))
    assert (a.log_prob == b.log_prob).all()
    for one, other in zip(a.modes(5), b.modes(5), strict=True):
        assert (one.T == other.T).all()


def test_touches_are_told_and_the_coverage_is_near_nominal(pin):
    touches = random_touches(pin, 60, seed=8)
    posteriors = [pin.localize(t.mask, kind="mask", effort="fast") for t in touches]
    gain = np.array([p.log_density(t.T_sensor_object) for p, t in zip(posteriors, touches, strict=True)])
    level = np.array([p.credible_level(t.T_sensor_object) for p, t in zip(posteriors, touches, strict=True)])
    assert gain.mean() - 2 * gain.std() / np.sqrt(len(gain)) > 0
    for nominal in (0.5, 0.9):
        error = 3.3 * np.sqrt(nominal * (1 - nominal) / len(level))
        assert abs((level <= nominal).mean() - nominal) < 0.10 + error


def test_wrong_words_name_the_right_ones(plug):
    mask = np.ones(plug.sensor.image_size_px[::-1], bool)
    with pytest.raises(GeomtactError, match="balanced"):
        plug.localize(mask, effort="balancd")
    with pytest.raises(GeomtactError, match="one image"):
        plug.localize([mask, mask])
    with pytest.raises(GeomtactError, match="T_sensor_object"):
        plug.simulate(np.ones((4, 4)))
