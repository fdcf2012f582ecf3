"""A board of pins measures how many millimetres a pixel is, through a lens that distorts."""

import numpy as np
import pytest

from geomtact import ImageError, UsageError
from geomtact.sensing.image_file import read_image
from geomtact.sensing.pins import pixel_pitch_of_pins

MM = 1e-3
SHAPE = (240, 320)


def board(apart, bend=0.0, turned=0.0, bright=False, columns=9, rows=7, pins=1.0, off=(3.0, -5.0)):
    """An image (H, W, 3) of pins that are ``apart`` = (along x, along y) pixels in the middle, and its background."""
    i, j = np.meshgrid(np.arange(columns) - columns // 2, np.arange(rows) - rows // 2)
    c, s = np.cos(turned), np.sin(turned)
    place = np.stack([c * i - s * j, s * i + c * j], -1).reshape(-1, 2)
    uv = place * (1 + bend * (place**2).sum(1, keepdims=True)) * apart + (np.array(SHAPE[::-1]) - 1) / 2 + off
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    dark = sum(np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * (0.1 * min(apart)) ** 2)) for x, y in uv)
    background = np.stack([0.6 + 0.1 * u / SHAPE[1], 0.6 + 0.05 * v / SHAPE[0], np.full(SHAPE, 0.55)], -1)
    noise = 0.004 * np.random.default_rng(0).normal(size=(2, *SHAPE, 3))
    sign = 1 if bright else -1
    return np.clip(background + sign * 0.1 * pins * dark[..., None] + noise[0], 0, 1), np.clip(
        background + noise[1], 0, 1
    )


@pytest.mark.parametrize("bend", [0.0, 0.012, -0.004])
@pytest.mark.parametrize("turned", [0.0, 0.1])
def test_the_pitch_is_that_of_the_middle_whatever_the_lens_does(bend, turned):
    found = pixel_pitch_of_pins(*board((26, 26), bend, turned), 2.5 * MM)
    # the image's middle is not the lens's: a little beside it pins are a little farther apart
    assert found.pixel_pitch == pytest.approx((2.5 * MM / 26, 2.5 * MM / 26), rel=0.01)
    assert len(found.pins) >= 50 and max(found.std) < 0.01
    assert (found.stretch > 0.1) == (bend == 0.012) and (found.stretch < -0.02) == (bend == -0.004)


@pytest.mark.parametrize("bright", [False, True])
def test_pixels_may_be_wider_than_high_and_pins_brighter_than_the_gel(bright):
    found = pixel_pitch_of_pins(*board((30, 24), bright=bright), 2 * MM)
    assert found.pixel_pitch == pytest.approx((2 * MM / 30, 2 * MM / 24), rel=0.01)
    # each pin stands where it was put
    expected = found.places * [30, 24] + (np.array(SHAPE[::-1]) - 1) / 2 + [3, -5]
    assert np.abs(found.pins - expected).max() < 1.0


def test_a_board_that_is_none_is_refused(rng):
    image, background = board((26, 26))
    with pytest.raises(UsageError, match=r"expected metres.*2\.5 mm is 0\.0025"):
        pixel_pitch_of_pins(image, background, 2.5)
    with pytest.raises(ImageError, match="expected a grid of pins"):
        pixel_pitch_of_pins(background, background, 2.5 * MM)
    with pytest.raises(ImageError, match="expected a grid of pins"):
        pixel_pitch_of_pins(*board((26, 26), columns=3), 2.5 * MM)
    with pytest.raises(ImageError, match="expected the size of the image"):
        pixel_pitch_of_pins(image, background[:-1], 2.5 * MM)
    scattered = np.clip(background - 0.1 * (rng.random((*SHAPE, 1)) > 0.999), 0, 1)
    with pytest.raises(ImageError, match="expected a grid of pins"):
        pixel_pitch_of_pins(scattered, background, 2.5 * MM)


def test_a_real_board_gives_the_pitch_of_its_makers(data_folder):
    folder = data_folder / "ninedtact_calib" / "sensor_1" / "camera_calibration"
    found = pixel_pitch_of_pins(read_image(folder / "sample.png"), read_image(folder / "ref.png"), 2.5 * MM)
    theirs = np.load(folder / "position_scale.npy", allow_pickle=False)[2] * MM
    assert len(found.pins) == 63
    assert found.pixel_pitch == pytest.approx((theirs, theirs), rel=0.02)
    assert 0.2 < found.stretch < 0.4  # a wide lens
