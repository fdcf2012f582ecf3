"""Laws of a Gaussian prior at any pose: it is as exact as it is narrow, and poses are drawn from it without bias."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from speed import slow_but

from geomtact import GaussianPrior, Posterior, se3
from geomtact.contact_space.contact_maps import located
from geomtact.contact_space.touches import random_touches
from geomtact.geometry.distance import PoseDistance
from geomtact.geometry.symmetry import about
from geomtact.inference.densities import images
from geomtact.inference.particles import Target
from geomtact.inference.pose_prior import NormalPrior
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
    poses, membrane = located(index, near)
    found = at_poses(index, prior).log_density(replace(poses, reach=membrane + 1e-3), np.full(40, 1e-3))
    if symmetry.kind in ("none", "discrete"):
        expected = np.logaddexp.reduce([prior(near @ S) for S in symmetry.elements], 0)
        np.testing.assert_allclose(np.ptp(found - expected), 0, atol=1e-6)
    for S in images(symmetry)[:4]:
        poses, membrane = located(index, near @ S)
        again = at_poses(index, prior).log_density(replace(poses, reach=membrane + 1e-3), np.full(40, 1e-3))
        np.testing.assert_allclose(again, found, atol=1e-6)


@pytest.mark.parametrize("turn", [0.1, 0.5])
def test_draws_have_its_mean(localizer, turn, rng):
    """The mean of a prior over what touches, from its own draws and from uniform ones."""
    index = localizer.index
    touch = random_touches(localizer.space, 1, 5)[0]
    prior = at_poses(index, known(localizer, touch.T_sensor_object, turn, 10e-3))
    query = ContactQuery.of(touch.mask, localizer.sensor)
    poses, depth, log_ratio, rotation = prior.draw(20_000, query, rng)
    T = localizer.space.sample(20_000, rng)[0]
    assert np.isfinite(log_ratio).all() and ((depth >= 0) & (depth <= localizer.sensor.max_penetration)).all()
    target = Target(index, query, np.zeros(index.places), prior)
    drawn = target.admitted(target.evaluated(poses, depth=depth))
    touches = np.isfinite(drawn.log_likelihood)
    height = np.where(touches, drawn.poses.reach, 0.0) - depth
    own = np.exp(np.where(touches, log_ratio + prior.of_image(rotation, poses.centre, height), -np.inf))
    uniform = np.exp(target.particles_at(T).log_prior)
    error = np.hypot(own.std() / own.mean(), uniform.std() / uniform.mean()) / np.sqrt(20_000)
    assert np.log(own.mean() / uniform.mean()) == pytest.approx(0, abs=4 * error + 0.05)


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


def test_turns_about_a_symmetry_do_not_matter(pin, uniform_poses):
    T = uniform_poses(pin)[0][0]
    symmetry = pin.mesh.symmetry
    turned = T @ about(Rotation.from_rotvec(0.8 * symmetry.axis).as_matrix(), symmetry.centre)
    densities = []
    for pose in (T, turned):
        poses, membrane = located(pin.index, pose[None])
        prior = at_poses(pin.index, known(pin, T, 0.2, 2e-3))
        densities.append(prior.of_image(pose[None, :3, :3], poses.centre, membrane))
    np.testing.assert_allclose(*densities, atol=1e-9)
