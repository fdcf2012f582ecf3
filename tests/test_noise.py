"""The noise on masks has the stated size and correlation, and nothing else."""

import numpy as np
import pytest

from geomtact.sensing.noise import CLEAN, HEAVY, MODERATE, Noise, correlation_length, perturb, smooth_field

PITCH = (0.0634e-3, 0.0634e-3)
SHAPE = (240, 320)


def disk(radius=4e-3, shape=SHAPE, pitch=PITCH, centre=(0.0, 0.0)):
    x, y = ((np.arange(n) - (n - 1) / 2) * p for n, p in zip(shape[::-1], pitch, strict=True))
    return np.hypot(x - centre[0], y[:, None] - centre[1]) <= radius


@pytest.mark.parametrize("correlation", [1e-3, 2e-3, 3e-3])
def test_field_has_unit_variance_everywhere_and_the_stated_correlation(correlation):
    rng = np.random.default_rng(0)
    x, y = np.arange(40) * 0.5e-3, np.arange(30) * 0.25e-3
    fields = np.stack([smooth_field(x, y, correlation, rng) for _ in range(4000)])
    assert np.abs(fields.mean(0)).max() < 0.08
    assert np.abs(fields.std(0) - 1).max() < 0.06
    column, row = round(correlation / 0.5e-3), round(correlation / 0.25e-3)
    along_x = (fields[..., column:] * fields[..., :-column]).mean()
    along_y = (fields[:, row:] * fields[:, :-row]).mean()
    assert along_x == pytest.approx(np.exp(-1), abs=0.02)
    assert along_y == pytest.approx(np.exp(-1), abs=0.02)


@pytest.mark.parametrize("rms", [0.1e-3, 0.2e-3])
@pytest.mark.parametrize("pitch", [PITCH, (0.127e-3, 0.0634e-3)])
def test_outline_moves_along_its_normal_by_the_stated_rms(rms, pitch, rng):
    """The right half is in contact: its border, row by row, is displaced with the stated rms and no bias."""
    mask = np.zeros((240, 160), bool)
    mask[:, 80:] = True
    noise = Noise(outline_rms=rms)
    moved = np.stack([80 - perturb(mask, pitch, noise, rng)[:, 60:].sum(1) for _ in range(300)])
    moved = moved * pitch[0]
    assert np.sqrt((moved**2).mean()) == pytest.approx(rms, rel=0.08)
    assert abs(moved.mean()) < 0.1 * rms


def test_same_seed_gives_the_same_mask_and_the_input_is_left_alone():
    mask = disk()
    before = mask.copy()
    for noise in (MODERATE, HEAVY):
        first, second = (perturb(mask, PITCH, noise, np.random.default_rng(7)) for _ in range(2))
        np.testing.assert_array_equal(first, second)
        assert (first != perturb(mask, PITCH, noise, np.random.default_rng(8))).any()
    np.testing.assert_array_equal(mask, before)


def test_clean_changes_nothing(rng):
    mask = disk()
    result = perturb(mask, PITCH, CLEAN, rng)
    np.testing.assert_array_equal(result, mask)
    assert result is not mask


@pytest.mark.parametrize("noise", [MODERATE, HEAVY])
def test_empty_mask_gets_nothing_but_specks(noise, rng):
    from scipy import ndimage

    areas, counts = [], []
    for _ in range(30):
        labels, n = ndimage.label(perturb(np.zeros(SHAPE, bool), PITCH, noise, rng))
        counts.append(n)
        areas += list(np.bincount(labels.ravel())[1:])
    assert max(counts) == noise.specks
    diameter = 2 * np.sqrt(np.median(areas) * PITCH[0] * PITCH[1] / np.pi)
    assert diameter == pytest.approx(0.35e-3, abs=PITCH[0])


def test_on_a_coarse_grid_a_speck_is_at_least_one_pixel(rng):
    assert 1 <= perturb(np.zeros((24, 32), bool), (0.6e-3, 0.6e-3), MODERATE, rng).sum() <= 2


def test_a_patch_is_missing_as_often_as_stated(rng):
    mask = disk()
    noise = Noise(outline_rms=0.0, missing_probability=0.7)
    lost = np.array([1 - perturb(mask, PITCH, noise, rng).sum() / mask.sum() for _ in range(400)])
    assert (lost > 0).mean() == pytest.approx(0.7, abs=0.07)
    assert lost.max() < 0.4


def test_full_contact_stays_full_but_for_the_patch(rng):
    """A contact cut by the border goes on beyond it, so moving it uncovers nothing."""
    assert perturb(np.ones(SHAPE, bool), PITCH, MODERATE, rng).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_tiny_grids(shape, rng):
    assert perturb(np.ones(shape, bool), PITCH, HEAVY, rng).shape == shape


@pytest.mark.parametrize("length", [0.3e-3, 1e-3])
def test_the_correlation_length_of_a_field_is_found(length, rng):
    """In images of any shape and size; some with holes."""
    x, y = np.arange(120) * 0.05e-3, np.arange(90) * 0.06e-3
    fields = [smooth_field(x, y[: 90 - k], length, rng) for k in range(12)]
    for field in fields[::3]:
        field[20:50, 30:50] = np.nan
    assert correlation_length(fields, (0.05e-3, 0.06e-3)) == pytest.approx(length, rel=0.15)


def test_what_correlates_everywhere_does_as_far_as_it_reaches():
    assert correlation_length([np.ones((20, 30))], (1e-4, 1e-4)) == pytest.approx(np.hypot(19, 29) * 1e-4, rel=0.02)
