"""Laws of the image under the object's symmetry that is reported: the nearest to the prior, or to the frame before."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from speed import slow_but
from trimesh.creation import box, cylinder

from geomtact import Localizer, Sensor
from geomtact.contact_space.space import ContactSpace
from geomtact.geometry.distance import PoseDistance
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.densities import GaussianPrior
from geomtact.inference.distribution import Refined
from geomtact.inference.effort import GRID_ALONE
from geomtact.inference.modes import carried, grown
from geomtact.inference.posterior import Posterior
from geomtact.inference.reference import Reference
from geomtact.se3 import exp, inverse, log, transform
from tools.studies.track.trajectories import random_trajectory

MM = 1e-3
T_WORLD = exp([0.3, -1.2, 0.5, 0.4, -0.1, 0.7])
STD = np.repeat([0.1, 2 * MM], [3, 3])
SYMMETRIC = ("pin", "ball", "curved", "flat_nut")


def rms(mesh, T, others):
    """Root mean square distance (m,) [m] of the surface's points from pose ``T`` (4, 4) to ``others`` (m, 4, 4)."""
    points = np.column_stack([mesh.surface_points(5000), np.ones(5000)])
    moments = np.mean([S @ (points.T @ points / 5000) @ S.T for S in mesh.symmetry.sampled(12)], 0)
    moved = (np.asarray(others, float) - T)[:, :3]
    return np.sqrt(np.einsum("mij,jk,mik->m", moved, moments, moved).clip(0))


def check_nearest(mesh, T, reference, allowed=None):
    """No image of ``T`` (4, 4) is nearer to ``reference`` (4, 4), but for the few points by which images are compared."""
    images = T @ mesh.symmetry.sampled(360 if mesh.symmetry.axis is not None else 30)
    if allowed is not None:
        images = images[allowed(images)]
    least = rms(mesh, reference, images).min()
    assert rms(mesh, reference, T[None])[0] <= 1.02 * least + 2e-5


def an_image(localizer, T, rng):
    """An image (4, 4) of a pose that the approach allows."""
    images = T @ localizer.mesh.symmetry.sampled(36)
    return rng.choice(images[localizer.space.approaches(images)])


def mesh_of(solid):
    return Mesh(MM * solid.vertices, solid.faces, "solid", "mm").with_symmetry()


SOLIDS = {
    "two-fold": lambda: load_mesh("elbow_pipe"),
    "brick": lambda: mesh_of(box((10, 20, 30))),
    "six-fold": lambda: load_mesh("gear"),
    "six-fold, and flips": lambda: load_mesh("hex_nut"),
    "axis": lambda: load_mesh("damping_pin"),
    "axis, and flips": lambda: mesh_of(cylinder(6, 20, sections=64)),
    "ball": lambda: load_mesh("ball"),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_no_image_is_nearer_to_the_reference_and_all_touch(name, rng):
    mesh = SOLIDS[name]()
    space = ContactSpace(mesh, Sensor.load("gelsight-mini"))
    T, depth = space.sample(12, rng)
    S = mesh.symmetry.sampled(72)
    for pose, S_before in zip(T, S[rng.integers(len(S), size=len(T))], strict=True):
        for off in (1e-6 * np.ones(6), rng.normal(0, STD)):
            before = pose @ S_before @ exp(off)
            reference = Reference((T_WORLD @ before)[None], np.zeros(1))
            image = reference.nearest(pose[None], space, T_WORLD)[0]
            check_nearest(mesh, image, before)
            assert np.isfinite(space.penetration(image[None]))[0]
            assert PoseDistance(mesh).largest(image, pose[None])[0] < 1e-4
            assert np.array_equal(reference.nearest(pose[None], space, T_WORLD)[0], image)
    assert np.isfinite(depth).all()


def forms_of_prior(T):
    """A prior about ``T`` (4, 4) in every form, but for a posterior."""
    gaussian = GaussianPrior(T, np.diag(STD**2))
    cloud = T @ exp(np.random.default_rng(4).normal(0, 0.2 * STD, (1100, 6)))
    cloud[0] = T  # off it, those of an exact contact face hardly touch as the approach allows
    return {
        "Gaussian": gaussian,
        "function": lambda others: gaussian(others),
        "pair": (cloud[:50], np.zeros(50)),
        "large pair": (cloud, np.full(1100, -3.0)),
    }


@pytest.mark.parametrize("name", slow_but(SYMMETRIC, "ball", "flat_nut"))
def test_modes_are_the_images_nearest_to_a_prior(name, request, a_touch, rng):
    localizer = request.getfixturevalue(name)
    T, mask = a_touch(localizer)
    T = T_WORLD @ an_image(localizer, T, rng)
    forms = forms_of_prior(T)
    del forms["Gaussian"]  # which takes seconds; it is tried before the disk
    for prior in forms.values():
        posterior = localizer.localize(mask, T_world_sensor=T_WORLD, prior=prior, effort=GRID_ALONE)
        plain = replace(posterior, reference=None)
        allowed = None if localizer.space.cones is None else lambda T: localizer.space.approaches(inverse(T_WORLD) @ T)
        for mode, own in zip(posterior.modes(2), plain.modes(2), strict=True):
            assert mode.probability == own.probability and mode.refined == own.refined
            assert PoseDistance(localizer.mesh).largest(own.T, mode.T[None])[0] < 1e-4
        first = posterior.modes(1)[0]
        check_nearest(localizer.mesh, first.T, T, allowed)
        assert posterior.log_density(first.T) == pytest.approx(plain.log_density(plain.modes(1)[0].T), abs=1e-9)
        likeliest = posterior.likeliest(3)
        assert PoseDistance(localizer.mesh).largest(plain.likeliest(1)[0], likeliest[:1])[0] < 1e-4
        check_nearest(localizer.mesh, likeliest[0], T, allowed)


@pytest.mark.parametrize("name", slow_but(SYMMETRIC, "ball", "flat_nut"))
def test_a_posterior_as_prior_hands_its_image_on_by_disk_too(name, request, a_touch, rng, tmp_path):
    localizer = request.getfixturevalue(name)
    T, mask = a_touch(localizer)
    T = an_image(localizer, T, rng)
    first = localizer.localize(mask, prior=GaussianPrior(T, np.diag(STD**2)))
    check_nearest(localizer.mesh, first.modes(1)[0].T, T, localizer.space.approaches)
    first.save(tmp_path / "first.npz")
    again = Posterior.load(tmp_path / "first.npz", localizer.cache_dir)
    for a, b in zip(first.modes(), again.modes(), strict=True):
        assert np.array_equal(a.T, b.T) and np.array_equal(a.covariance, b.covariance)
        assert np.array_equal(a.observable, b.observable)
    for prior in (first, tmp_path / "first.npz"):
        second = localizer.localize(mask, prior=prior, effort=GRID_ALONE)
        for mode in second.modes(3):
            check_nearest(localizer.mesh, mode.T, first.modes(1)[0].T, localizer.space.approaches)


def test_observable_directions_turn_with_the_image_of_a_mode(curved, a_touch, rng):
    """Moved by xi, a pose is moved by A xi as its image: the covariance and what is observable follow."""
    T, mask = a_touch(curved)
    posterior = curved.localize(mask)
    compared = 0
    for S in curved.mesh.symmetry.elements[1::3]:
        at = posterior.modes(1)[0].T @ S
        turned = replace(posterior, reference=Reference(at[None], np.zeros(1)))
        for own, image in zip(posterior.modes(3), turned.modes(3), strict=True):
            element = inverse(own.T) @ image.T
            A = np.stack([log(inverse(image.T) @ own.T @ exp(xi) @ element) for xi in 1e-6 * np.eye(6)], 1) / 1e-6
            np.testing.assert_allclose(image.covariance, A @ own.covariance @ A.T, rtol=1e-4, atol=1e-12)
            scale = np.repeat([own.length, 1.0], 3)
            assert image.observable.shape == own.observable.shape
            np.testing.assert_allclose(image.observable @ image.observable.T, np.eye(len(own.observable)), atol=1e-9)
            unseen = np.eye(6) - own.observable.T @ own.observable
            xi = unseen @ rng.normal(size=6) / scale
            assert np.abs(image.observable @ (scale * (A @ xi))).max(initial=0) < 1e-4 * np.linalg.norm(scale * xi)
            compared += len(own.observable) > 0
    assert compared > 3


def test_unobservable_directions_are_the_same_in_every_image():
    """Of a nut far off the origin of its file, where its turns shift the origin too."""
    symmetry = load_mesh("hex_nut").symmetry
    C = np.diag(np.arange(1.0, 7.0)) * 1e-4
    found = Refined(np.eye(4), C, np.eye(6)[[0, 3]], 5 * MM, True)
    for S in symmetry.elements:
        away = transform(np.eye(3), [0.3, 0.1, -0.2])
        S = away @ S @ inverse(away)
        image = carried(found, S)
        back = carried(image, np.eye(4))
        np.testing.assert_allclose(back.covariance, C, atol=1e-12)
        np.testing.assert_allclose(back.observable.T @ back.observable, np.diag([1, 0, 0, 1, 0, 0]), atol=1e-9)


@pytest.mark.parametrize(("name", "turns"), [pytest.param("pin", 720, marks=pytest.mark.slow), ("ball", 40)])
def test_a_function_is_asked_which_image_it_prefers(name, turns, request, a_touch, rng):
    """Where turns are continuous its largest value is found to a tenth of a degree."""
    localizer = request.getfixturevalue(name)
    T, mask = a_touch(localizer)
    T = an_image(localizer, T, rng)

    def density(others):
        turned = Rotation.from_matrix(np.swapaxes(others[:, :3, :3], 1, 2) @ T[:3, :3]).magnitude()
        return -0.5 * (turned / 0.05) ** 2

    mode = localizer.localize(mask, prior=density).modes(1)[0]
    images = mode.T @ localizer.mesh.symmetry.sampled(turns)
    assert density(mode.T[None])[0] >= density(images).max() - 0.01


def test_the_poses_with_more_mass_choose_the_image(flat_nut, a_touch):
    T, mask = a_touch(flat_nut)
    images = T @ flat_nut.mesh.symmetry.elements
    first, second = images[flat_nut.space.approaches(images)][:2]
    many = np.stack([first] * 9 + [second] * 11)
    for poses, log_mass, expected in (
        (many, np.zeros(20), second),
        (many, np.r_[np.zeros(9), np.full(11, -1.0)], first),
        (np.tile(many, (100, 1, 1)), np.zeros(2000), second),
        (many, np.r_[np.full(9, -5.0), np.full(11, -np.inf)], first),
    ):
        mode = flat_nut.localize(mask, prior=(poses, log_mass), effort=GRID_ALONE).modes(1)[0]
        check_nearest(flat_nut.mesh, mode.T, expected, flat_nut.space.approaches)


def test_an_image_that_the_approach_rules_out_is_not_reported(flat_nut, a_touch):
    """The frame before had the nut upside down."""
    T, mask = a_touch(flat_nut)
    images = T @ flat_nut.mesh.symmetry.elements
    below = images[~flat_nut.space.approaches(images)]
    assert len(below) == 6
    posterior = replace(flat_nut.localize(mask), reference=Reference(below[:1], np.zeros(1)))
    for mode in posterior.modes(3):
        assert np.isfinite(posterior.log_density(mode.T))
        check_nearest(flat_nut.mesh, mode.T, below[0], flat_nut.space.approaches)


@pytest.mark.parametrize("name", slow_but(SYMMETRIC, "ball", "flat_nut"))
def test_a_track_does_not_jump_between_images(name, request):
    localizer: Localizer = request.getfixturevalue(name)
    masks = random_trajectory(localizer.space, 4, 3).masks
    before = None
    for posterior in localizer.track([*masks[:3], np.zeros_like(masks[0]), masks[3]], T_WORLD, effort=GRID_ALONE):
        modes = posterior.modes(2)
        assert bool(modes) == posterior.contact
        for mode in modes:
            if before is not None:
                to_sensor = inverse(posterior.T_frame_sensor)
                check_nearest(localizer.mesh, to_sensor @ mode.T, to_sensor @ before, localizer.space.approaches)
        before = modes[0].T if modes else before


@pytest.mark.parametrize("form", slow_but(["Gaussian", "function", "pair", "posterior"], "function"))
def test_a_track_begins_at_the_image_of_its_prior(flat_nut, form, rng):
    trajectory = random_trajectory(flat_nut.space, 3, 5)
    T = an_image(flat_nut, trajectory.T_sensor_object[0], rng)
    prior = forms_of_prior(T).get(form)
    if form == "posterior":
        prior = flat_nut.localize(trajectory.masks[0], prior=GaussianPrior(T, np.diag(STD**2)), effort=GRID_ALONE)
        T = prior.modes(1)[0].T
    masks = [np.zeros_like(trajectory.masks[0]), *trajectory.masks]
    _, first, *rest = flat_nut.track(masks, prior=prior, effort=GRID_ALONE)
    check_nearest(flat_nut.mesh, first.modes(1)[0].T, T, flat_nut.space.approaches)
    for posterior in rest:  # less than the sixth of a turn after which the nut looks the same
        turned = Rotation.from_matrix(posterior.modes(1)[0].T[:3, :3].T @ T[:3, :3]).magnitude()
        assert turned < np.radians(60)


@pytest.mark.slow
def test_several_sensors_report_the_image_of_the_prior(pin, rng):
    T, _ = pin.space.sample(60, rng, (0.6 * MM, 1.2 * MM))
    T = max(T, key=lambda T: pin.simulate(T).mask.sum())
    mask = pin.simulate(T).mask
    image = T_WORLD @ an_image(pin, T, rng)
    prior = GaussianPrior(image, np.diag(STD**2))
    away = transform(np.eye(3), [0, 0, -0.3])
    posterior = pin.localize(
        [mask, np.zeros_like(mask)], T_world_sensor=[T_WORLD, T_WORLD @ away], prior=prior, effort=GRID_ALONE
    )
    check_nearest(pin.mesh, posterior.modes(1)[0].T, image)


def test_without_symmetry_or_prior_nothing_is_turned(plug, flat_nut, a_touch):
    T, mask = a_touch(plug)
    assert plug.localize(mask, prior=GaussianPrior(T, np.diag(STD**2)), effort=GRID_ALONE).reference is None
    posterior = flat_nut.localize(a_touch(flat_nut)[1], effort=GRID_ALONE)
    assert posterior.reference is None
    heart = posterior.index.poses(np.array([cell for cell, _ in grown(posterior, 1)]))
    assert np.array_equal(posterior.modes(1)[0].T, heart[0])
