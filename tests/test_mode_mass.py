"""The masses of modes: integrals of the density, whatever number of particles was found there."""

from types import SimpleNamespace

import numpy as np
import pytest
from speed import slow_but

from geomtact.geometry.distance import PoseDistance
from geomtact.inference import mode_mass
from geomtact.se3 import exp, inverse, log

WIDTH = np.array([0.02, 0.015, 0.03, 2e-4, 4e-4, 1e-4])  # rad and metres along xi
MASS = np.array([0.3, 0.6, 0.05])
COUNT = np.array([500, 40, 90])  # particles: not as the masses are


FACES = {"bracket, two faces": [((0, 0, 1), 0.0), ((0, 0, -1), 0.0)], "damping_pin, a side": [((1, 0, 0), 0.0)]}


@pytest.fixture(scope="module", params=slow_but(["bracket", "hex_nut", "damping_pin", *FACES], "bracket", *FACES))
def normal_modes(request, make_localizer):
    """Three places with normal densities, of which particles were drawn in other numbers, and half as wide."""
    name, approach = request.param.partition(",")[0], FACES.get(request.param)
    index, rng = make_localizer(name, "gelslim", max_poses=20_000, approach=approach).index, np.random.default_rng(0)
    distance, hearts = PoseDistance(index.mesh, 128), index.poses(index.possible[:1])
    for T in index.poses(rng.permutation(index.possible)[:500]):
        if len(hearts) < 3 and distance.mean(T, hearts).min() > 20e-3:
            hearts = np.concatenate([hearts, T[None]])
    assert len(hearts) == 3
    bases = [index.directions.motions(heart[:3, :3]) for heart in hearts]
    width = np.append(WIDTH[: len(bases[0]) - 3], WIDTH[3:])

    def log_normal(T):
        """Log density (n,) over the uniform one."""
        each = []
        for heart, basis, mass in zip(hearts, bases, MASS, strict=True):
            off = log(inverse(heart) @ distance.aligned(heart, T)) @ np.linalg.pinv(basis) / width
            each.append(np.log(mass / np.prod(width)) - 0.5 * (np.square(off) + np.log(2 * np.pi)).sum(1))
        return np.logaddexp.reduce(each) - np.log(index.uniform_density(T))

    drawn = [
        heart @ exp(0.5 * width * rng.normal(size=(n, len(width))) @ basis)
        for heart, basis, n in zip(hearts, bases, COUNT, strict=True)
    ]
    poses = np.concatenate(drawn)
    return hearts, SimpleNamespace(
        index=index,
        poses=poses,
        weight=np.full(len(poses), 1 / len(poses)),
        log_density=log_normal(poses),
        contacts=0,
        density=SimpleNamespace(
            target=SimpleNamespace(
                particles_at=lambda T, errors=None: SimpleNamespace(T=T, log_likelihood=np.zeros(len(T))),
                displaced=lambda T, errors: T,
                sensors=1,
                carried=0,
                others=(),
            ),
            of_exact=lambda particles: log_normal(particles.T),
            log_density=lambda T: np.zeros(len(T)),
            log_inside=0.0,
        ),
    )


@pytest.fixture
def weighed(normal_modes, monkeypatch):
    """Hearts and masses of the modes, and the log of their sum; of modes that are wide enough to hold all."""
    monkeypatch.setattr(mode_mass, "mode_radius", lambda _: 10e-3)
    monkeypatch.setattr(
        mode_mass, "replace", lambda explored, **changes: SimpleNamespace(**{**vars(explored), **changes})
    )
    return mode_mass.weighed(normal_modes[1], np.zeros((0, 4, 4)), 0.0, 9000, np.random.default_rng(1))


def test_a_mass_is_the_integral_of_the_density(normal_modes, weighed):
    found, log_sum = weighed
    hearts, distance = normal_modes[0], PoseDistance(found.index.mesh, 128)
    near = np.array([distance.mean(heart, hearts) for heart in found.hearts]).argmin(1)
    assert near.tolist() == [1, 0, 2]  # the most probable first
    np.testing.assert_allclose(found.masses, MASS[near], rtol=0.2)  # by 450 draws each
    assert np.exp(log_sum) == pytest.approx(MASS.sum(), rel=0.1)


def test_modes_that_overlap_share_their_poses(normal_modes, weighed, monkeypatch):
    """Of narrower modes there are several about one place. Each pose counts once, and the leading mode has as much as alone."""
    monkeypatch.setattr(mode_mass, "mode_radius", lambda _: 0.6e-3)
    found, log_sum = mode_mass.weighed(normal_modes[1], np.zeros((0, 4, 4)), 0.0, 9000, np.random.default_rng(1))
    assert len(found.hearts) > 3 and (np.diff(found.masses) <= 0).all()
    assert found.masses.sum() < 1.1 and np.exp(log_sum) == pytest.approx(found.masses.sum(), rel=1e-6)
    leading = found.hearts[0]
    monkeypatch.setattr(
        mode_mass,
        "_grown",
        lambda explored, further, distance, radius, count: (found.hearts[:1], [near(distance, radius)]),
    )

    def near(distance, radius):
        return np.flatnonzero(distance.within(leading, normal_modes[1].poses, radius))

    alone, log_all = mode_mass.weighed(normal_modes[1], np.zeros((0, 4, 4)), 0.0, 9000, np.random.default_rng(1))
    # the poses beside it count as they are; all mass then adds up to more than 1, by which it is divided
    assert log_all > 0 and alone.masses[0] * np.exp(log_all) == pytest.approx(found.masses[0], rel=0.25)


def test_no_draw_decides_alone():
    log_weight = np.zeros(400)
    log_weight[7] = 50.0
    assert mode_mass._log_mean(log_weight) == pytest.approx(50 - 1.5 * np.log(400), abs=1e-6)
    assert mode_mass._log_mean(np.zeros(400)) == pytest.approx(0)
    assert mode_mass._log_mean(np.full(400, -np.inf)) == -np.inf
