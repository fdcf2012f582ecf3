"""Poses that registration finds lead several sensors to the posterior, with its evidence."""

import numpy as np
import pytest

from geomtact import se3
from geomtact.evaluation import simultaneous_touches
from geomtact.inference.distribution import cell_densities
from geomtact.inference.effort import Effort
from geomtact.inference.fusion import joint_problem
from geomtact.inference.particles import SURE, OtherSensor
from geomtact.inference.population import Population
from geomtact.inference.registered import AboutModes, bridged, united
from geomtact.inference.sampler import explore
from geomtact.scoring.contact_likelihood import ContactQuery


@pytest.fixture(scope="module", params=["damping_pin", "elbow_pipe"])
def localizer(request, make_localizer):
    return make_localizer(request.param, "gelslim", max_poses=100_000)


@pytest.fixture(scope="module")
def scenes(localizer):
    return list(simultaneous_touches(localizer.space, 5, 2, 5))


def target_of(localizer, scene, seed=0, contacts=6_000):
    """What poses of two sensors are judged by, two runs that found the posterior without registration, and what registers."""
    masks, index = [touch.mask for touch in scene.touches], localizer.index
    cells = localizer.localize(masks, "mask", None, scene.T_world_sensor, effort=Effort(0))
    coarse = (cell_densities(cells).reshape(index.weight.shape) * index.weight).sum(0, dtype=float)
    T_other_first = se3.inverse(scene.T_world_sensor[1]) @ scene.T_world_sensor[0]
    first, second = (ContactQuery.of(mask, localizer.sensor) for mask in masks)
    other = OtherSensor(index, second, T_other_first)
    runs = explore(index, first, coarse, contacts, np.random.default_rng(seed), None, [other], runs=2)
    shown = [(observation.contact, localizer.sensor) for observation in cells.observations]
    problem = joint_problem(shown, np.stack([np.eye(4), se3.inverse(T_other_first)]), 20)
    return runs[0].density.target, runs, localizer.mode_refiner.searching(index, problem)


@pytest.mark.slow
def test_the_evidence_about_modes_is_that_of_the_posterior(localizer, scenes):
    """Where few places suit, both ways to the posterior give its evidence: in the median of 5 scenes within a nat. On the elbow
    pipe more suit than are registered, and it is less."""
    off = []
    for scene in scenes:
        target, runs, search = target_of(localizer, scene, contacts=60_000)
        some = runs[0].particles[-1].joined(runs[1].particles[-1])
        about = AboutModes.of(target, some.take(np.arange(0, len(some), 3)), search)
        found = bridged(about, SURE, 2, 400, np.random.default_rng(1))
        at = runs[0].density.powers.index(SURE)
        of_modes = found.log_evidence.mean() if found else -np.inf
        off.append(of_modes - np.mean([run.log_evidence[at] for run in runs]))
    assert np.median(off) < 1, off
    assert localizer.mesh.name != "damping_pin" or np.median(off) > -1, off


def test_draws_about_modes_have_their_density(localizer, scenes):
    """So the mean of one of them over another, from which poses are drawn, is 1 but for what cannot touch."""
    target, runs, search = target_of(localizer, scenes[0])
    about = AboutModes.of(target, runs[0].particles[len(runs[0].particles) // 2], search)
    assert len(about.hearts) <= 12
    rng = np.random.default_rng(0)
    few = AboutModes(
        target, about.hearts[:1], about.bases[:1], about.students[:1], about.led_to, about.origin, about.best, 0
    )
    drawn, counts = about.draw(4000, rng)
    some = target.particles_at(drawn)
    inside = np.isfinite(some.log_target(0)) & counts
    ratio = np.exp(few.log_density(some) - about.log_density(some))
    drawn, counts = few.draw(4000, rng)
    share = (np.isfinite(target.particles_at(drawn).log_target(0)) & counts).mean()
    mean = np.where(inside, ratio, 0).mean()
    assert mean == pytest.approx(share, abs=4 * np.std(np.where(inside, ratio, 0)) / np.sqrt(4000) + 0.05)


def test_populations_are_united_by_what_they_found(localizer, scenes):
    """The likelier one has the poses; both where they are alike; and one alone is itself."""
    _, runs, _ = target_of(localizer, scenes[0])
    some = runs[0].particles[-1]

    def population(log_evidence, draw):
        particles = some.take(np.arange(40) % len(some))
        particles.draw[:] = draw
        return Population(
            runs[0].density.target, np.random.default_rng(0), particles, np.array([log_evidence, 0.0]), np.zeros(2)
        )

    likelier = united(population(0.0, 1), population(9.0, 2))
    draws = likelier.particles.draw.reshape(2, -1)
    assert (draws[0] == 2).mean() > 0.9 and 0.1 < (draws[1] == 2).mean() < 0.9
    np.testing.assert_array_equal(likelier.log_evidence, [9.0, 0.0])
    assert united(None, None) is None and united(likelier, None) is likelier and united(None, likelier) is likelier
