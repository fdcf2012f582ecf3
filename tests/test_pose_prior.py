"""Laws of a Gaussian prior at any pose: it is as exact as it is narrow, and poses are drawn from it without bias."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from speed import slow_but

from geomtact import GaussianPrior, Posterior, se3
from geomtact.contact_space.touches import random_touches
from geomtact.geometry.distance import PoseDistance
from geomtact.inference.densities import images
from geomtact.inference.particles import Target, poses_of
from geomtact.inference.pose_prior import NormalPrior
from geomtact.inference.sampler import _log_measure
from geomtact.scoring.contact_likelihood import ContactQuery
from geomtact.se3 import exp

KINDS = ("plug", "pin", "cone", "ball", "curved")  # no symmetry, an axis, cones of approach, a sphere, a finite group


@pytest.fixture(scope="module", params=slow_but(KINDS, "plug"))
def localizer(request):
    return request.getfixturevalue(request.param)


def known(localizer, T, turn, shift):
    """A prior about ``T``, whose axes are not those of the object's frame."""
    R = Rotation.from_rotvec([0.4, -0.3, 0.7]).as_matrix()
    wide = np.diag([turn, 0.7 * turn, 1.3 * turn, shift, 0.8 * shift, 1.2 * shift])
    root = np.kron(np.eye(2), R) @ wide
    to_centre = se3.adjoint(se3.transform(np.eye(3), localizer.mesh.centre))
    return GaussianPrior(T, to_centre @ root @ root.T @ to_centre.T)


def at_poses(index, prior):
    return NormalPrior(index, np.zeros(len(index)), prior)


def test_it_is_the_gaussian(localizer, uniform_poses, rng):
    """Up to a constant: summed over a finite symmetry's images, whatever the turn about an axis."""
    index, symmetry = localizer.index, localizer.mesh.symmetry
    T, depth = uniform_poses(localizer)
    prior = known(localizer, T[0], 0.3, 4e-3)
    near = T[0] @ exp(0.5 * rng.multivariate_normal(np.zeros(6), prior.covariance, 40))
    allowed = localizer.space.approaches(near)
    found = at_poses(index, prior).log_density(near)
    if symmetry.kind in ("none", "discrete"):
        expected = np.logaddexp.reduce([prior(near @ S) for S in symmetry.elements], 0)
        assert np.ptp((found - expected)[allowed]) < 1e-6 and np.isneginf(found[~allowed]).all()
    for S in images(symmetry)[:4]:
        ok = allowed & localizer.space.approaches(near @ S)
        np.testing.assert_allclose(at_poses(index, prior).log_density(near @ S)[ok], found[ok], atol=1e-6)


@pytest.mark.parametrize("turn", slow_but((0.7, 1.5, 4.0), 1.5))
def test_draws_have_its_mean(localizer, turn, rng):
    """The mean of a prior over what touches, from its own draws and from uniform ones."""
    index = localizer.index
    touch = random_touches(localizer.space, 1, 5)[0]
    prior = at_poses(index, known(localizer, touch.T_sensor_object, turn, 20e-3))
    query = ContactQuery.of(touch.mask, localizer.sensor)
    poses, depth, log_ratio, rotation = prior.draw(20_000, query, rng)
    T = localizer.space.sample(2000, rng)[0]
    assert (log_ratio < np.inf).all() and ((depth >= 0) & (depth <= localizer.sensor.max_penetration)).all()
    target = Target(index, query, np.zeros(index.places), prior)
    drawn = target.admitted(target.evaluated(poses, depth=depth))
    touches = np.isfinite(drawn.log_likelihood)
    at = poses_of(replace(drawn.poses, rotation=rotation), depth, localizer.mesh.centre)
    own = np.exp(np.where(touches, log_ratio + prior.own_density(at), -np.inf)) * np.exp(_log_measure(target, rng))
    uniform = np.exp(prior.log_density(T))
    error = np.hypot(own.std() / own.mean() / np.sqrt(len(own)), uniform.std() / uniform.mean() / np.sqrt(len(T)))
    assert error < 0.3
    assert np.log(own.mean() / uniform.mean()) == pytest.approx(0, abs=3 * error + 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("mm", [1, 3])
def test_a_touch_adds_to_a_narrow_prior(plug, mm):
    """The first mode is nearer to the truth than the prior's own mean, in the mean of twelve touches, and the true pose is denser
    than before."""
    distance, rng, off, gain = PoseDistance(plug.mesh), np.random.default_rng(0), [], []
    for touch in random_touches(plug.space, 12, 11):
        T = touch.T_sensor_object
        std = np.repeat([np.radians(mm), 1e-3 * mm], 3)
        about_centre = se3.adjoint(se3.transform(np.eye(3), plug.mesh.centre))
        covariance = about_centre @ np.diag(std**2) @ about_centre.T
        mean = T @ exp(about_centre @ (std * rng.normal(size=6)))
        posterior = plug.localize(touch.mask, "mask", prior=GaussianPrior(mean, covariance))
        off.append([distance.mean(T, distance.aligned(T, pose[None]))[0] for pose in (posterior.modes(1)[0].T, mean)])
        gain.append(posterior.log_density(T))
    mode, prior = np.mean(off, 0)
    assert mode < prior
    # what a prior of such a width says alone, of a centre that moves over 20 mm and any rotation
    assert np.mean(gain) > 6 * np.log(20 / mm) - 6


@pytest.mark.slow
def test_a_saved_posterior_keeps_it(plug, a_touch, tmp_path):
    T, mask = a_touch(plug)
    posterior = plug.localize(mask, "mask", prior=known(plug, T, 0.1, 2e-3))
    posterior.save(tmp_path / "posterior.npz")
    loaded = Posterior.load(tmp_path / "posterior.npz")
    assert isinstance(loaded.explored.density.target.prior, NormalPrior)
    np.testing.assert_allclose(
        loaded.log_density(posterior.poses[:50]), posterior.log_density(posterior.poses[:50]), atol=1e-6
    )


@pytest.mark.parametrize("mm", [0.1, 0.5])
def test_a_posterior_is_no_wider_than_a_narrow_prior(plug, a_touch, mm):
    """Even where that is narrower than the errors of the contact's place, over which the likelihood is averaged: of the square of
    the distance, in standard deviations of the prior, which has a mean of six, at most 5 % are above 16.8 (1 % in the prior)."""
    T, mask = a_touch(plug)
    prior = known(plug, T, np.radians(mm), 1e-3 * mm)
    posterior = plug.localize(mask, "mask", prior=prior)
    square = -2 * prior(posterior.poses)
    assert square.mean() < 7 and (square > 16.8).mean() < 0.05
    assert posterior.log_density(T) > posterior.information_gain_nats - 6


def test_track_takes_it_as_localize_does(plug, a_touch):
    T, mask = a_touch(plug)
    prior = known(plug, T, 0.02, 1e-3)
    (first,) = plug.track([mask], prior=prior)
    alone = plug.localize(mask, prior=prior)
    assert isinstance(first.explored.density.target.prior, NormalPrior)
    assert first.log_density(T) == pytest.approx(alone.log_density(T), abs=1.0)
