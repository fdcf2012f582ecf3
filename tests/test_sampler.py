"""Contacts cut at any pose, their likelihood, and the density that is sampled from it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from speed import slow_but

from geomtact import Sensor
from geomtact.contact_space.contact_maps import SHAPE, ContactMaps, located
from geomtact.contact_space.touches import random_touches
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference import explored, population, sampler, two_runs
from geomtact.inference.particles import Target, poses_of
from geomtact.inference.sampler import explore
from geomtact.scoring.contact_likelihood import POWERS, RATE, ContactQuery
from geomtact.se3 import random_rotations, transform
from geomtact.sensing.noise import CLEAN

SCENES = {"gelslim": None, "digit": None, "gelslim from above": [((0.0, 0.0, 1.0), 1.0)]}


@pytest.fixture(scope="module", params=slow_but(SCENES, "gelslim"))
def localizer(request, make_localizer):
    sensor = Sensor.load(request.param.split()[0])
    return make_localizer(load_mesh("pin"), sensor, approach=SCENES[request.param], max_poses=20_000)


@pytest.fixture(scope="module")
def maps(localizer):
    return ContactMaps.of(localizer.index)


def coarse_of(localizer, mask):
    """Mass of every place in the coarse posterior."""
    posterior = localizer.localize(mask, kind="mask")
    mass = np.zeros(localizer.index.height.size)
    np.add.at(mass, posterior.cells, np.exp(posterior.cell_log_prob))
    return mass.reshape(localizer.index.height.shape).sum(0)


def energies_of(localizer, maps, elastic):
    """At the true poses of clean touches: energies (n, SHARES) [nats], by those where nothing is touched too, and errors of the
    depth."""
    energies, relative, off = [], [], []
    for touch in random_touches(localizer.space, 12, 5, elastic=elastic, noise=CLEAN):
        query = ContactQuery.of(touch.mask, localizer.sensor)
        poses, membrane = located(maps.index, touch.T_sensor_object[None])
        found = maps.compare(query.samples, query.area, poses, membrane)
        energies.append(RATE * found.energy[0])
        relative.append(found.energy[0] / -query.samples.least)
        off.append(abs(found.reach[0] - membrane[0] - touch.penetration))
    return np.array(energies), np.array(relative), np.array(off)


def test_a_cut_contact_is_the_cast_one(localizer, maps):
    """A clean rigid contact has next to no energy at its own pose and at the whole depth: some ten nats, also where a near
    camera sees a curved membrane."""
    energies, relative, off = energies_of(localizer, maps, elastic=False)
    assert np.median(energies[:, -1]) < 30 and np.median(relative[:, -1]) < 0.1
    pitch = np.sqrt(localizer.sensor.pixel_area(localizer.sensor.along(SHAPE)))
    assert np.median(off) < pitch  # the deepest point lies between samples


def test_an_elastic_contact_is_near_a_share_of_the_depth(localizer, maps):
    """It is smaller than the rigid one, and at some share little of it is missing."""
    _, energies, _ = energies_of(localizer, maps, elastic=True)
    best = energies.argmin(1)
    assert (best < energies.shape[1] - 1).all()
    assert np.median(energies.min(1)) < 0.15
    assert np.median(energies[:, -1]) > 3 * np.median(energies.min(1))


def test_images_under_the_symmetry_are_equally_dense(localizer, maps):
    touch = random_touches(localizer.space, 1, 7)[0]
    query = ContactQuery.of(touch.mask, localizer.sensor)
    (run,) = explore(maps.index, query, coarse_of(localizer, touch.mask), 2000, np.random.default_rng(0))
    images = touch.T_sensor_object @ localizer.mesh.symmetry.elements
    assert len(images) > 1
    density = run.density.log_density(images)
    assert np.ptp(density) < 1e-3


def test_the_same_seed_gives_the_same_posterior(localizer, maps):
    touch = random_touches(localizer.space, 1, 8)[0]
    query, coarse = ContactQuery.of(touch.mask, localizer.sensor), coarse_of(localizer, touch.mask)
    (one,), (other,) = (explore(maps.index, query, coarse, 2000, np.random.default_rng(3)) for _ in range(2))
    assert one.log_evidence == other.log_evidence
    for mine, others in zip(one.particles, other.particles, strict=True):
        T, again = (poses_of(p.poses, p.depth, localizer.mesh.centre) for p in (mine, others))
        np.testing.assert_array_equal(T, again)


def test_the_evidence_does_not_depend_on_the_budget(localizer, maps):
    """Its mean over seeds is that of a budget fifteen times as large, within four standard errors and a tenth, by a power of
    0.03. By larger ones a small budget may miss where the likelihood is highest: see docs/adaptive.md."""
    touch = random_touches(localizer.space, 3, 9)[2]
    query, coarse = ContactQuery.of(touch.mask, localizer.sensor), coarse_of(localizer, touch.mask)

    def evidence(contacts, runs):
        return np.array(
            [
                run.log_evidence[POWERS.index(0.03)]
                for run in explore(maps.index, query, coarse, contacts, rng, runs=runs)
            ]
        )

    rng = np.random.default_rng(0)
    ratio = np.exp(evidence(4000, 12) - evidence(60_000, 1))
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(len(ratio)) + 0.1


def test_the_uniform_density_has_the_measure_of_the_cells(localizer, maps):
    """Poses in a box about all touches: their mean density times its volume is the share of the cells' measure that touches."""
    index, rng, n = localizer.index, np.random.default_rng(0), 60_000
    half = np.array(localizer.sensor.half_window) + localizer.mesh.diameter / 2
    R = random_rotations(n, rng)
    T = transform(R, np.column_stack([rng.uniform(-half, half, (n, 2)), np.zeros(n)]) - R @ localizer.mesh.centre)
    T = T[index.space.approaches(T)]
    depth = localizer.sensor.max_penetration
    target = Target(index, ContactQuery.of(np.ones((48, 64)), localizer.sensor), np.zeros(index.places), None)
    touches = np.isfinite(target.evaluated(located(index, T)[0], depth=depth * rng.random(len(T))).log_likelihood)
    density = index.uniform_density(T) / index.directions.symmetry.density * touches * 4 * half.prod() * depth
    share = index.cell_measure / index.cell_measure.sum()
    drawn, log_weight, _ = sampler._draw(target, share, 1, 20_000, rng)
    of_cells = np.exp(logsumexp(log_weight[0] + drawn.log_target(0)))
    assert density.sum() / n == pytest.approx(of_cells, rel=5 * density.std() / density.sum() * np.sqrt(len(T)) + 0.02)


def test_a_step_ends_where_it_is_to_end():
    """However much the weights change."""
    change = np.array([[0.0] + [-1e6] * 99])
    assert population._next_step(change, 5e-5) == 5e-5 and population._next_step(change, 0.1) < 0.1
    assert population._next_step(np.zeros((2, 9)), 0.1) == 0.1


def test_particles_stay_in_the_contact_pose_space(localizer, maps):
    touch = random_touches(localizer.space, 1, 10)[0]
    query = ContactQuery.of(touch.mask, localizer.sensor)
    (run,) = explore(maps.index, query, coarse_of(localizer, touch.mask), 3000, np.random.default_rng(0))
    assert len(run.particles) == len(POWERS) == len(run.log_evidence)
    for particles in run.particles[1:]:
        assert np.isfinite(particles.log_likelihood).all()
        assert ((particles.depth >= 0) & (particles.depth <= localizer.sensor.max_penetration)).all()
    assert run.density.weights.sum() == pytest.approx(1)
    assert run.contacts <= 1.25 * 3000
    found, _ = two_runs._explored_from(run, 10_000, np.random.default_rng(1))
    assert len(found.poses) == round(np.exp(found.density.log_inside) * sum(map(len, run.particles)))
    assert ((found.depth >= 0) & (found.depth <= localizer.sensor.max_penetration)).all()


def test_the_density_at_a_particle_is_what_the_sampler_found(localizer, maps, monkeypatch):
    """If there are no errors, the poses alone give the densities back, those that moved exactly."""
    monkeypatch.setattr(explored, "nodes", lambda: (np.zeros((1, 4)), np.zeros(1)))
    touch = random_touches(localizer.space, 1, 11)[0]
    query = ContactQuery.of(touch.mask, localizer.sensor)
    (run,) = explore(maps.index, query, coarse_of(localizer, touch.mask), 3000, np.random.default_rng(0))
    off = []
    for particles in run.particles:
        T = poses_of(particles.poses, particles.depth, localizer.mesh.centre)
        off.append(np.abs(run.density.log_density(T) - run.density.of_exact(particles)))
    assert np.quantile(off[-1], 0.9) < 0.01
    assert np.quantile(np.concatenate(off), 0.75) < 0.1


def test_maps_in_the_cache_are_those_that_were_cast(localizer, maps):
    """In another process, or after the file was damaged, contacts are the same to the last bit."""
    (path,) = localizer.index.folder.glob("maps-*.npz")
    again = ContactMaps.of(replace(localizer.index)).maps
    np.testing.assert_array_equal(again.heights, maps.maps.heights)
    np.testing.assert_array_equal(again.widest, maps.maps.widest)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    anew = ContactMaps.of(replace(localizer.index)).maps
    np.testing.assert_array_equal(anew.heights, maps.maps.heights)
    assert path.read_bytes() == whole
