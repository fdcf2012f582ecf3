"""Contacts cut at any pose, their likelihood, and the density that is sampled from it."""

import numpy as np
import pytest

from geomtact import Sensor
from geomtact.contact_space.contact_maps import SHAPE, ContactMaps
from geomtact.contact_space.touches import random_touches
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.sampler import explore
from geomtact.scoring.contact_likelihood import ContactQuery
from geomtact.sensing.noise import CLEAN


@pytest.fixture(scope="module", params=["gelslim", pytest.param("digit", marks=pytest.mark.slow)])
def localizer(request, make_localizer):
    return make_localizer(load_mesh("pin"), Sensor.load(request.param), max_poses=20_000)


@pytest.fixture(scope="module")
def maps(localizer):
    return ContactMaps.cast(localizer.index)


def coarse_of(localizer, mask):
    """Mass of every place in the coarse posterior."""
    posterior = localizer.localize(mask, kind="mask")
    mass = np.zeros(localizer.index.height.size)
    np.add.at(mass, posterior.cells, np.exp(posterior.log_prob))
    return mass.reshape(localizer.index.height.shape).sum(0)


def test_a_cut_contact_is_the_cast_one(localizer, maps):
    """A clean rigid contact has next to no energy at its own pose, of what it has where nothing is touched."""
    touches = random_touches(localizer.space, 12, 5, elastic=False, noise=CLEAN)
    shares, off = [], []
    for touch in touches:
        query = ContactQuery.of(touch.mask, localizer.sensor)
        poses = maps.locate(touch.T_sensor_object[None], np.array([touch.penetration]))
        found = maps.compare(query.samples, poses, query.area)
        depth = touch.penetration / localizer.sensor.max_penetration * (found.energy.shape[1] - 1)
        at_depth = np.interp(depth, np.arange(found.energy.shape[1]), found.energy[0])
        shares.append(at_depth / found.energy[0, 0])
        off.append(abs(found.reach[0] - poses.reach[0]))
    assert np.median(shares) < 0.15
    pitch = np.sqrt(localizer.sensor.pixel_area(localizer.sensor.along(SHAPE)))
    assert np.median(off) < pitch  # the deepest point lies between samples


def test_images_under_the_symmetry_are_equally_dense(localizer, maps):
    touch = random_touches(localizer.space, 1, 7)[0]
    query = ContactQuery.of(touch.mask, localizer.sensor)
    explored = explore(maps, query, coarse_of(localizer, touch.mask), 2000, np.random.default_rng(0))
    images = touch.T_sensor_object @ localizer.mesh.symmetry.elements
    assert len(images) > 1
    density = explored.log_density(images, np.full(len(images), touch.penetration))
    assert np.ptp(density) < 1e-3


def test_the_same_seed_gives_the_same_posterior(localizer, maps):
    touch = random_touches(localizer.space, 1, 8)[0]
    query, coarse = ContactQuery.of(touch.mask, localizer.sensor), coarse_of(localizer, touch.mask)
    one, other = (explore(maps, query, coarse, 2000, np.random.default_rng(3)) for _ in range(2))
    assert one.log_evidence == other.log_evidence
    np.testing.assert_array_equal(one.particles.poses.centre, other.particles.poses.centre)


def test_the_evidence_does_not_depend_on_the_budget(localizer, maps):
    """Its mean over seeds is that of a budget twenty times as large, within four standard errors and a tenth."""
    touch = random_touches(localizer.space, 3, 9)[2]
    query, coarse = ContactQuery.of(touch.mask, localizer.sensor), coarse_of(localizer, touch.mask)
    large = explore(maps, query, coarse, 60_000, np.random.default_rng(0)).log_evidence
    small = [explore(maps, query, coarse, 3000, np.random.default_rng(1 + i)).log_evidence for i in range(12)]
    ratio = np.exp(np.array(small) - large)
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(len(ratio)) + 0.1


def test_particles_stay_in_the_contact_pose_space(localizer, maps):
    touch = random_touches(localizer.space, 1, 10)[0]
    query = ContactQuery.of(touch.mask, localizer.sensor)
    explored = explore(maps, query, coarse_of(localizer, touch.mask), 3000, np.random.default_rng(0))
    particles = explored.particles
    assert np.isfinite(particles.log_likelihood).all()
    assert ((particles.depth >= 0) & (particles.depth <= 1)).all()
    assert explored.contacts <= 3000
