"""Laws of the classical descriptors: what each one measures and what it ignores, on any grid, for any contact."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from geomtact.scoring.catalogue import SCORERS
from geomtact.scoring.descriptors import CLASSICAL, BlurredCosine, Chamfer, Fourier, Hu
from geomtact.scoring.vectors import VectorScorer
from geomtact.sensing.sensor import Sensor

WIDE = Sensor("wide", (320, 240), (1e-4, 1e-4), 0.0, 2e-3)  # a window of 32 x 24 mm
TALL = replace(WIDE, name="tall", image_size_px=(240, 320))
SHAPE = (48, 64)
TELL_PLACE = ("chamfer", "cosine", "hog", "fourier")


@pytest.fixture(params=CLASSICAL.values(), ids=CLASSICAL)
def descriptor(request):
    return request.param


def ellipse(x=0.0, y=0.0, a=6.0, b=3.0, angle=0.3, shape=SHAPE, sensor=WIDE):
    """An ellipse of half axes a, b [mm], its long axis ``angle`` [rad] from +x towards +y, centred at x, y [mm]."""
    X, Y = np.meshgrid(*(1e3 * c for c in sensor.pixel_centres(shape)))
    X, Y = X - x, Y - y
    u, v = X * np.cos(angle) + Y * np.sin(angle), -X * np.sin(angle) + Y * np.cos(angle)
    return (u / a) ** 2 + (v / b) ** 2 < 1


def hook(shape=SHAPE):
    """A contact that no turn and no mirror maps onto itself."""
    rows, columns = np.arange(shape[0]) / shape[0], np.arange(shape[1]) / shape[1]
    bar = (np.abs(rows - 0.5) < 0.25)[:, None] & (np.abs(columns - 0.40) < 0.07)
    arm = (np.abs(rows - 0.68) < 0.08)[:, None] & (np.abs(columns - 0.53) < 0.15)
    return bar | arm


def odd_contacts():
    """Nothing, everything, one pixel, lines, a few patches."""
    masks = np.zeros((7, *SHAPE), bool)
    masks[1] = True
    masks[2, 3, 5] = masks[3, 7] = masks[4, :, 0] = True
    masks[5] = ellipse(-8, 0, 3, 3) | ellipse(8, 0, 3, 3)
    masks[6] = ellipse(14, 10)
    return masks


def distance(descriptor, *masks, sensor=WIDE):
    """How far each mask's vector lies from the first one's."""
    vectors = np.concatenate([descriptor.describe(mask[None], sensor) for mask in masks])
    return np.linalg.norm(vectors[1:] - vectors[0], axis=1)


def test_all_descriptors_have_their_names():
    assert set(CLASSICAL) == {"chamfer", "cosine", "hu", "hog", "fourier", "fpfh"}
    assert all(name == d.name for name, d in CLASSICAL.items())
    assert set(CLASSICAL) <= set(SCORERS)


def test_vectors_of_anything_are_small_and_finite(descriptor):
    masks = odd_contacts()
    vectors = descriptor.describe(masks, WIDE)
    assert vectors.dtype == np.float32 and vectors.ndim == 2 and len(vectors) == len(masks)
    assert vectors.shape[1] <= 256
    assert np.isfinite(vectors).all()
    turned = descriptor.describe(np.rot90(masks, axes=(1, 2)), TALL)
    assert turned.shape == vectors.shape and np.isfinite(turned).all()


def test_a_batch_is_described_one_by_one_and_always_alike(descriptor):
    masks = odd_contacts()
    vectors = descriptor.describe(masks, WIDE)
    assert (vectors == np.concatenate([descriptor.describe(mask[None], WIDE) for mask in masks])).all()
    assert (vectors == descriptor.describe(masks.copy(), WIDE)).all()


def test_masks_are_left_as_they_were(descriptor):
    masks = odd_contacts()
    before = masks.copy()
    descriptor.describe(masks, WIDE)
    assert (masks == before).all()


@pytest.mark.parametrize("name", TELL_PLACE)
@pytest.mark.parametrize("along", [(1, 0), (0, 1), (-0.6, 0.8)])
def test_distance_grows_with_the_shift(name, along):
    shifts = np.array([0.0, 0.5, 1.0, 2.0, 4.0])
    far = distance(CLASSICAL[name], *(ellipse(s * along[0], s * along[1]) for s in shifts))
    assert (np.diff(far) > 0).all() and far[0] > 0


@pytest.mark.parametrize("name", TELL_PLACE)
def test_distance_grows_with_the_turn(name):
    far = distance(CLASSICAL[name], *(ellipse(angle=0.3 + t) for t in (0.0, 0.3, 0.6, 1.2)))
    assert (np.diff(far) > 0).all() and far[0] > 0


@pytest.mark.parametrize("shape", [(24, 32), (96, 128), (240, 320)])
def test_the_same_contact_on_another_grid_lies_near(descriptor, shape):
    """Nearer than other contacts by far; gradients and normals depend on the rim's steps, so they change more."""
    same, *others = distance(descriptor, ellipse(shape=shape), ellipse(), ellipse(4, 3, 5, 5), hook())
    assert same < (0.6 if descriptor.name in ("hog", "fpfh") else 0.2) * min(others)


def test_a_tall_window_is_a_wide_one_on_its_side(descriptor):
    masks = ellipse(), ellipse(2, 1), ellipse(0, 0, 5, 4, 1.2), hook()
    wide = distance(descriptor, *masks)
    tall = distance(descriptor, *(mask.T for mask in masks), sensor=TALL)
    assert tall == pytest.approx(wide, rel=2e-3)


@pytest.mark.parametrize("name", ["hu", "fpfh"])
def test_blind_descriptors_see_the_shape_alone(name):
    """Not the place, nor half and quarter turns."""
    here = hook()
    moved = [np.roll(here, (-4, 6), (0, 1)), np.rot90(here, 2)]
    same = distance(CLASSICAL[name], here, *moved)
    turned = CLASSICAL[name].describe(np.rot90(here)[None], TALL) - CLASSICAL[name].describe(here[None], WIDE)
    other = distance(CLASSICAL[name], here, ellipse())[0]
    assert max(*same, np.linalg.norm(turned)) < 0.02 * other


# --- what each one is


def test_chamfer_is_the_truncated_distance_to_the_contact():
    mask = ellipse()
    row, column = np.nonzero(mask)
    y, x = np.mgrid[:48, :64]
    nearest = np.sqrt(((y[..., None] - row) ** 2 + (x[..., None] - column) ** 2).min(2))
    expected = np.minimum(nearest / 12, 1).reshape(12, 4, 16, 4).mean((1, 3))
    assert Chamfer(reach=0.25).describe(mask[None], WIDE)[0] == pytest.approx(expected.ravel(), rel=0.02, abs=1e-5)
    assert (Chamfer().describe(np.zeros((1, 48, 64), bool), WIDE) == 1).all()


def test_cosine_vectors_have_unit_length():
    length = np.linalg.norm(BlurredCosine().describe(odd_contacts(), WIDE), axis=1)
    assert length == pytest.approx([0, 1, 1, 1, 1, 1, 1])


def test_hu_moments_agree_with_opencv():
    for mask in (hook(), ellipse(2, 1)):
        theirs = cv2.HuMoments(cv2.moments(mask.astype(np.uint8))).ravel()
        assert 10 ** np.abs(Hu().describe(mask[None], WIDE)[0]) * 1e-5 == pytest.approx(
            np.maximum(np.abs(theirs), 1e-5), rel=1e-4
        )


def test_hu_moments_know_pixels_that_are_not_square():
    square = replace(WIDE, image_size_px=(240, 240))
    along, across = (ellipse(a=8, b=3, angle=t, sensor=square) for t in (0, np.pi / 2))
    near, far = distance(Hu(), along, across, ellipse(a=6, b=3, angle=0, sensor=square), sensor=square)
    assert near < 0.1 * far


def test_fourier_measures_place_size_and_stretch():
    half_diagonal = 20.0  # mm
    disk, long = Fourier().describe(np.stack([ellipse(3, -2, 4, 4), ellipse(a=6, b=4, angle=1.0)]), WIDE)
    mean, first, last = (disk[k] + 1j * disk[9 + k] for k in (0, 1, 8))
    assert mean == pytest.approx((3 - 2j) / half_diagonal, abs=0.003)
    assert first == pytest.approx(4 / half_diagonal, abs=0.01) and abs(last) < 0.003
    first, last = (long[k] + 1j * long[9 + k] for k in (1, 8))
    # exactly (a + b) / 2 and (a - b) / 2 only if the outline were followed by its angle and not by its length
    assert first == pytest.approx(5 / half_diagonal, rel=0.05)
    assert abs(last) == pytest.approx(1 / half_diagonal, rel=0.4)
    assert np.angle(last) == pytest.approx(2 * 1.0, abs=0.2), "twice the angle of the long axis"


def test_fourier_distance_is_that_of_the_outlines():
    """A shift moves every point of the outline by as much, whatever the outline."""
    for contact in (ellipse, lambda x=0.0: np.roll(hook(), int(2 * x), 1)):
        assert distance(Fourier(), contact(), contact(x=2.0)) == pytest.approx([2 / 20.0], rel=0.02)


def test_fourier_start_point_never_jumps():
    masks = np.stack([ellipse(angle=t, shape=(240, 320)) for t in np.arange(0, 3.2, 0.05)])
    steps = np.linalg.norm(np.diff(Fourier().describe(masks, WIDE), axis=0), axis=1)
    assert steps.max() < 2 * np.median(steps)


# --- as scores


def test_a_stored_contact_is_most_like_itself(descriptor, flat_nut, rng):
    """Among some of the poses of an index; blind descriptors find others as like."""
    index = flat_nut.index
    masks = index.masks(rng.choice(len(index), 200, replace=False))
    grid = SimpleNamespace(sensor=index.sensor, resolution=index.resolution, height=np.zeros((2, 100)))
    scorer = VectorScorer(descriptor, descriptor.describe(masks, index.sensor))
    assert scorer.name == descriptor.name
    for i in (0, 70, 199):
        score = scorer.score(grid, masks[i])
        assert score.shape == (2, 100) and np.ptp(score) > 0
        assert score.ravel()[i] == pytest.approx(float(score.max()), abs=1e-4 * float(np.ptp(score)))
        assert abs(score.ravel()[i]) < 1e-4 * np.ptp(score)
