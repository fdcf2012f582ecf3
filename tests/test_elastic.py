"""The elastic contact agrees with Hertz, with the complementarity conditions and with an independent solver."""

import numpy as np
import pytest

from geomtact.sensing.elastic import elastic_contact, elastic_mask


def grid(shape, pitch):
    x, y = ((np.arange(n) - (n - 1) / 2) * p for n, p in zip(shape[::-1], pitch, strict=True))
    return np.meshgrid(x, y)


def ball(shape, pitch, radius, depth, centre=(0.0, 0.0)):
    """How far a ball lies below the membrane; -inf where it does not reach over."""
    X, Y = grid(shape, pitch)
    r2 = (X - centre[0]) ** 2 + (Y - centre[1]) ** 2
    return np.where(r2 < radius**2, depth - radius + np.sqrt(np.maximum(radius**2 - r2, 0)), -np.inf)


def bumps(rng, shape=(48, 64), pitch=(0.3e-3, 0.3e-3)):
    X, Y = grid(shape, pitch)
    depth = np.full(shape, -1e-3)
    for x, y, height in rng.uniform([-6e-3, -4e-3, 0.2e-3], [6e-3, 4e-3, 1e-3], (4, 3)):
        depth = np.maximum(depth, height - ((X - x) ** 2 + (Y - y) ** 2) / 8e-3)
    return depth, pitch


@pytest.mark.parametrize("radius, depth", [(20e-3, 1e-3), (20e-3, 0.3e-3), (10e-3, 0.5e-3), (6e-3, 0.3e-3)])
@pytest.mark.parametrize("pitch", [(0.1e-3, 0.1e-3), (0.12e-3, 0.08e-3)])
def test_ball_has_the_contact_radius_of_hertz(radius, depth, pitch):
    mask = elastic_mask(ball((120, 120), pitch, radius, depth), pitch)
    contact_radius = np.sqrt(mask.sum() * pitch[0] * pitch[1] / np.pi)
    assert contact_radius == pytest.approx(np.sqrt(radius * depth), rel=0.02, abs=0.3 * max(pitch))
    X, Y = grid(mask.shape, pitch)
    assert np.abs(np.hypot(X, Y)[mask].max() - np.sqrt(radius * depth)) < 1.5 * max(pitch)


def test_displacement_around_a_ball_is_that_of_hertz():
    pitch, radius, depth = (0.1e-3, 0.1e-3), 20e-3, 0.3e-3
    _, sunk = elastic_contact(ball((128, 160), pitch, radius, depth), pitch)
    X, Y = grid(sunk.shape, pitch)
    a, r = np.sqrt(radius * depth), np.hypot(X, Y)
    outside = r > 1.05 * a
    r = r[outside]
    # Johnson, Contact Mechanics, eq. 3.42a
    exact = ((2 * a**2 - r**2) * np.arcsin(a / r) + r * a * np.sqrt(1 - (a / r) ** 2)) / (np.pi * radius)
    assert np.abs(sunk[outside] - exact).max() < 0.01 * depth


def test_flat_punch_is_touched_everywhere():
    X, Y = grid((48, 64), (0.3e-3, 0.3e-3))
    depth = np.where(np.hypot(X, Y) < 4e-3, 0.7e-3, -np.inf)
    np.testing.assert_array_equal(elastic_mask(depth, (0.3e-3, 0.3e-3)), depth > 0)


def test_gel_never_enters_the_object_and_rests_on_it_in_contact(rng):
    for _ in range(10):
        depth, pitch = bumps(rng)
        mask, sunk = elastic_contact(depth, pitch)
        tolerance = 3e-3 * depth.max()
        assert mask.any() and (depth[mask] > 0).all()
        assert np.abs(sunk - depth)[mask].max() < tolerance
        assert (sunk - depth)[~mask].min() > -tolerance
        assert sunk.min() >= 0
        np.testing.assert_array_equal(mask, elastic_mask(depth, pitch))


def test_mask_does_not_depend_on_scale_and_follows_mirrors_and_margins(rng):
    depth, pitch = bumps(rng)
    mask = elastic_mask(depth, pitch)

    def differing(other):
        return (mask ^ other).sum()

    assert differing(elastic_mask(1e3 * depth, (1e3 * pitch[0], 1e3 * pitch[1]))) <= 2
    assert differing(elastic_mask(depth.T, pitch[::-1]).T) <= 2
    assert differing(elastic_mask(depth[::-1, ::-1], pitch)[::-1, ::-1]) <= 2
    assert differing(elastic_mask(np.pad(depth, 9, constant_values=-np.inf), pitch)[9:-9, 9:-9]) <= 2


def test_without_overlap_nothing_touches():
    for depth in (np.full((5, 7), -1e-3), np.full((5, 7), -np.inf), np.zeros((1, 1))):
        mask, sunk = elastic_contact(depth, (1e-4, 1e-4))
        assert not mask.any() and not sunk.any() and not elastic_mask(depth, (1e-4, 1e-4)).any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (48, 64)])
def test_contact_up_to_the_border(shape):
    """Outside the grid the gel is free: a face over the whole window is touched everywhere."""
    assert elastic_mask(np.full(shape, 1e-3), (3e-4, 3e-4)).all()


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_tamaas(seed):
    """An independent solver, given our load, finds our contact (it prescribes the load, so the two must be dual)."""
    tamaas = pytest.importorskip("tamaas")
    depth, pitch = bumps(np.random.default_rng(seed))
    mask, sunk = elastic_contact(depth, pitch)
    shape = depth.shape
    size = [shape[0] * pitch[1], shape[1] * pitch[0]]
    model = tamaas.Model(tamaas.model_type.basic_2d, size, list(shape))
    model.E, model.nu = 1.0, 0.0
    tamaas.ModelFactory.registerNonPeriodic(model, "DCFFT")
    load = float(pressure_of(depth, pitch).mean())
    solver = tamaas.PolonskyKeerRey(
        model, depth, 1e-10, tamaas.PolonskyKeerRey.pressure, tamaas.PolonskyKeerRey.pressure
    )
    solver.setIntegralOperator("DCFFT")
    solver.solve(load)
    theirs = np.asarray(model.traction) > 0
    assert (mask ^ theirs).sum() <= max(2, 0.01 * theirs.sum())


def pressure_of(depth, pitch):
    from geomtact.sensing import elastic

    return elastic._pressure(np.asarray(depth, np.float32), pitch)
