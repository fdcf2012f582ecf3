"""A faulty tactile image is detected; real ones, left as they are, are not suspected."""

import numpy as np
import pytest

from geomtact.sensing.image_faults import faults
from geomtact.sensing.image_file import read_image
from geomtact.sensing.reading import read_observation

FAULTS = {
    "exchanged": lambda image, background: (image[..., ::-1], background),
    "turned by 180": lambda image, background: (image[::-1, ::-1], background),
    "mirrored left to right": lambda image, background: (image[:, ::-1], background),
    "mirrored top to bottom": lambda image, background: (image[::-1], background),
    "the image is black": lambda image, background: (0.01 * image, background),
    "the background is black": lambda image, background: (image, 0.01 * background),
    "the image is overexposed": lambda image, background: (np.minimum(3.5 * image, 1), background),
    "darker than the background": lambda image, background: (0.7 * image, background),
    "are the same, pixel for pixel": lambda image, background: (image, image),
}


def torn(image, level):
    """With a tear along a curve, a twelfth of the image's height wide, through which ``level`` is seen."""
    import cv2

    h, w = image.shape[:2]
    along = np.linspace(0, 1, 40)
    curve = np.stack([w * (0.35 + 0.25 * along), h * (0.3 + 0.3 * along**2)], 1)
    mask = cv2.polylines(np.zeros((h, w), np.uint8), [curve.astype(np.int32)], False, 1, round(h / 12))
    return np.where(mask[..., None] > 0, level, image)


@pytest.fixture(scope="module")
def sets(data_folder):
    """For each set of real tactile images, its background and images, as 0..1."""

    def read(path):
        return read_image(path)[..., :3] / 255.0

    gelslam, fots = data_folder / "gelslam_gsmini_balls", data_folder / "fots_balls"
    board = data_folder / "ninedtact_calib" / "sensor_1"
    found = {
        "gelslam": (gelslam / "background.png", sorted(gelslam.glob("*mm/*.png"))),
        "gelsight": (fots / "gelsight_bg.png", sorted((fots / "gelsight").glob("*.png"))),
        "digit": (fots / "digit_bg.png", sorted((fots / "digit").glob("*.png"))),
        "pins": (board / "camera_calibration" / "ref.png", [board / "camera_calibration" / "sample.png"]),
        "9dtact": (board / "depth_calibration" / "ref.png", [board / "depth_calibration" / "sample.png"]),
    }
    return {name: (read(background), [read(image) for image in images]) for name, (background, images) in found.items()}


def test_no_real_tactile_image_is_suspected(sets):
    assert sum(len(images) for _, images in sets.values()) == 103
    for name, (background, images) in sets.items():
        assert [faults(image, background) for image in images] == [[]] * len(images), name
        assert [faults(image, None) for image in images] == [[]] * len(images), name


@pytest.mark.parametrize("level", [0.03, 1.0])
def test_a_torn_gel_is_found_whenever_it_tore(sets, level):
    """A camera sees the dark, or a lamp, through it; before the background was taken or after."""
    for name in ("gelslam", "gelsight", "digit"):
        background, images = sets[name]
        for image in images[::4]:
            for before in (background, torn(background, level), None):
                (said,) = faults(torn(image, level), before)
                assert "torn" in said, name


def test_a_background_that_shows_a_contact_is_found(sets):
    """Exchanged with the image always, another press in its place nine times of ten; an untouched gel's noise is none."""
    found = []
    for name in ("gelslam", "gelsight", "digit"):
        background, images = sets[name]
        others = images[len(images) // 2 :] + images[: len(images) // 2]
        assert all("show a contact" in faults(background, image)[0] for image in images), name
        found += ["show a contact" in " ".join(faults(*pair)) for pair in zip(images, others, strict=True)]
        noise = 0.02 * np.random.default_rng(0).normal(size=background.shape)
        assert faults(np.clip(background + noise, 0, 1), background) == []
    assert np.mean(found) > 0.9


def test_markers_are_no_tear(sets):
    """Nine by seven black dots of a thirtieth of the image's width."""
    import cv2

    for background, images in sets.values():
        h, w = background.shape[:2]
        dots = np.zeros((h, w), np.uint8)
        for x in np.linspace(0.1, 0.9, 9):
            for y in np.linspace(0.1, 0.9, 7):
                cv2.circle(dots, (round(w * x), round(h * y)), round(w / 60), 1, -1)
        assert faults(*(np.where(dots[..., None] > 0, 0.03, each) for each in (images[0], background))) == []


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_found_on_every_coloured_sensor(sets, fault):
    for name in ("gelslam", "gelsight", "digit"):
        background, images = sets[name]
        for image in images[::4]:
            (said,) = faults(*FAULTS[fault](image, background))
            assert fault in said, name


def test_a_background_of_another_sensor_is_found(sets):
    import cv2

    coloured = ("gelslam", "gelsight", "digit", "9dtact")
    for name in coloured:
        image = sets[name][1][0]
        for other in coloured:
            if other != name:
                background = cv2.resize(sets[other][0], image.shape[1::-1])
                assert any("another sensor or light" in said or "fits" in said for said in faults(image, background))


def test_a_square_image_that_is_turned_is_found(rng):
    x, y = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 64))
    background = np.stack([0.2 + 0.5 * x, 0.3 + 0.4 * y, 0.7 - 0.4 * x * y], -1)
    image = np.clip(background + 0.01 * rng.normal(size=background.shape), 0, 1)
    assert faults(image, background) == []
    assert "90 degrees to the left" in faults(np.rot90(image), background)[0]
    assert "90 degrees to the right" in faults(np.rot90(image, -1), background)[0]


def test_a_fault_is_a_warning_of_the_tactile_image(sets):
    background, images = sets["gelslam"]
    seen = read_observation(images[0][..., ::-1].copy(), "gelsight-mini", "reading", background)
    assert any("red and blue seem to be exchanged" in warning for warning in seen.warnings)
    assert read_observation(images[0], "gelsight-mini", "reading", background).warnings == []
