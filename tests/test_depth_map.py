"""A depth map in another unit, or from another zero, is refused with the conversion that it needs; a right one passes."""

import re

import cv2
import numpy as np
import pytest

from geomtact import load_mesh
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_depth_map
from geomtact.errors import ImageError
from geomtact.sensing.depth_map import depths_of
from geomtact.sensing.reading import read_observation
from geomtact.sensing.sensor import Sensor
from tools.studies.readings.groove import read_scan

MINI = Sensor.load("gelsight-mini")
PITCH = 0.0634e-3
ROWS, COLUMNS = np.mgrid[:240, :320]
FAR2 = PITCH**2 * ((COLUMNS - 190) ** 2 + (ROWS - 100) ** 2)


def ball(depth, radius=4e-3):
    """How deep (240, 320) a ball [m] presses into a rigid gel that it touches down to ``depth`` [m]."""
    return np.maximum(np.sqrt(np.maximum(radius**2 - FAR2, 0)) - radius + depth, 0)


def read(array, kind="auto"):
    return read_observation(array, MINI, kind=kind)


@pytest.mark.parametrize("depth", [3e-4, 6e-4, 1e-3, 1.5e-3])
@pytest.mark.parametrize(
    ("unit", "conversion"),
    [
        (1e-3, "millimetres by 0.001"),
        (1e-6, "micrometres by 1e-06"),
        (PITCH, "pixels (of gs_sdk) by 6.34e-05"),
        (1e-2, "centimetres by 0.01"),
        (25.4e-3, "inches by 0.0254"),
    ],
)
def test_another_unit_is_refused_with_its_conversion(depth, unit, conversion):
    """Of the conversions that are named, one is right, and each makes a touch within the gel's depth."""
    given = ball(max(depth, 20e-3 * 1.01 * unit)) / unit  # deep enough to be over 10 max_penetration
    for array in (given, given.astype(np.float32)):
        with pytest.raises(ImageError, match=re.escape(conversion)) as error:
            read(array)
        assert "expected depths in metres up to about 0.002" in str(error.value) and "\n" not in str(error.value)
    for factor in re.findall(r" by ([\d.e-]+)", str(error.value)):
        assert 0.01 * 2e-3 <= float(factor) * given.max() <= 1.5 * 2e-3


def test_the_message_for_gs_sdks_pixels():
    with pytest.raises(ImageError) as error:
        read(ball(5e-4) / PITCH)
    assert str(error.value) == (
        "image: expected depths in metres up to about 0.002, the largest is 7.886; multiply pixels (of gs_sdk) by "
        "6.34e-05; or is it a camera's image: --kind reading"
    )


@pytest.mark.parametrize("unit", [1, 1e-3, PITCH])
def test_contact_below_a_rest_of_0_is_refused(unit):
    """As gs_sdk and gsrobotics give it: the mean is 0, or the rest is, and contact is negative."""
    for array in (-ball(6e-4), ball(6e-4).mean() - ball(6e-4)):
        with pytest.raises(
            ImageError, match="where contact is negative negate them, and set the gel at rest to 0"
        ) as error:
            read(array / unit)
        assert (unit == 1) == ("multiply" not in str(error.value))
        assert unit != PITCH or "pixels (of gs_sdk) by 6.34e-05" in str(error.value)


@pytest.mark.parametrize("unit", [1e-2, 25.4e-3])
def test_heights_a_little_too_large_may_be_in_centimetres_or_inches(unit):
    """Their size does not settle which: all that make a touch are listed."""
    (warning,) = (said for said in read(ball(1e-4) / unit).warnings if "exceed" in said)
    assert "exceed the sensor's max_penetration_mm, 2; if they are pixels times 0.001, multiply by 0.0634" in warning
    assert "or else centimetres by 0.01, or inches by 0.0254" in warning


def test_no_unit_is_named_that_makes_no_touch():
    with pytest.raises(
        ImageError, match="the largest is 1e[+]09; no usual unit makes a touch of them: give metres; or is"
    ):
        read(ball(1e-3) * 1e12)


def correlated(rng, sigma, width):
    noise = cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), width) if width else rng.normal(size=(240, 320))
    return sigma * noise / noise.std()


@pytest.mark.parametrize("width", [0, 3, 10])
def test_noise_about_the_gel_at_rest_is_no_contact(rng, width):
    touch = ball(8e-4)
    given = touch + correlated(rng, 5e-6, width)
    assert -3e-5 < given.min() < -1e-5
    seen = read(given)
    assert not any("were set to 0" in said for said in seen.warnings)
    np.testing.assert_array_equal(seen.contact.height, np.maximum(given, 0).astype(np.float32))
    assert not seen.contact.mask[touch == 0].any()


@pytest.mark.parametrize("sigma", [2e-6, 3e-5, 9e-5])
@pytest.mark.parametrize("width", [0, 3, 10])
def test_noise_about_0_alone_is_no_contact(rng, sigma, width):
    given = correlated(rng, sigma, width)
    seen = read(given)
    assert not seen.contact.mask.any() and not seen.contact.height.any()
    assert seen.warnings == [
        f"image: depths of {1e6 * given.min():.2g} to {1e6 * given.max():.2g} micrometres are noise about 0: taken as no contact"
    ]


@pytest.mark.parametrize(
    "given",
    [
        pytest.param(np.where(COLUMNS < 160, 2e-4, -2e-4), id="half of the gel is touched, the mean is 0"),
        pytest.param(ball(2e-3, 2e-2) - ball(2e-3, 2e-2).mean(), id="a large touch, the mean is 0"),
        pytest.param(1e-6 * (COLUMNS - 160), id="a slope"),
        pytest.param(ball(1e-4) - np.roll(ball(1e-4), 90), id="as low as high"),
    ],
)
def test_symmetric_heights_are_not_always_noise(given, rng):
    for noisy in (given, given + correlated(rng, 2e-6, 2)):
        with pytest.raises(ImageError, match="depths of the gel's indentation are >= 0"):
            read(noisy)


def test_large_noise_is_read_with_a_warning(rng):
    seen = read(ball(1.2e-3) + correlated(rng, 3e-5, 0))
    assert any(re.search(r"depths down to -1\.\de\+02 micrometres were set to 0", said) for said in seen.warnings)
    assert not seen.contact.mask[ball(1.2e-3) == 0].any()


@pytest.mark.parametrize(
    "given",
    [
        pytest.param(ball(8e-4) - 2e-5, id="the gel at rest lies lower"),
        pytest.param(ball(8e-4) - ball(8e-4).mean(), id="its mean is 0"),
        pytest.param(ball(3e-4) - np.roll(ball(2e-4), 90), id="as low as a touch"),
        pytest.param(np.where(ball(8e-4) > 0, -4e-5, 0) + 2e-5, id="contact is negative"),
        pytest.param(ball(2e-3) - np.roll(ball(6e-4), 90), id="lower than the sensor's noise makes any"),
    ],
)
def test_negative_heights_that_are_no_noise_are_refused_with_what_to_do(given, rng):
    for noisy in (given, given + correlated(rng, 2e-6, 2)):
        with pytest.raises(
            ImageError, match=r"set the gel at rest to 0; clip noise that is left below it, numpy\.maximum"
        ):
            read(noisy)


@pytest.mark.parametrize("rest", [8e-4, 2e-3, 2.9e-3])
@pytest.mark.parametrize("noise", [0, 5e-6])
def test_distances_to_the_gel_are_suspected(rest, noise, rng):
    given = rest - ball(8e-4) + correlated(rng, noise, 2) + 4 * noise
    (warning,) = (said for said in read(given).warnings if "distances" in said)
    assert warning == (
        "image: the border is as deep as anything, and the inside is not, as in a map of distances to the gel; if it is one, "
        f"give the distances at rest less these, as {given.max():.4g} - depths"
    )
    back = read(np.maximum(given.max() - given, 0))
    assert not any("distances" in said for said in back.warnings)


def test_a_plate_that_fills_the_window_is_no_map_of_distances(rng):
    for plate in (5e-4 + 0 * ROWS, 5e-4 + 1e-6 * ROWS, 5e-4 + correlated(rng, 5e-6, 0)):
        assert not any("distances" in said for said in read(plate).warnings)


@pytest.mark.parametrize("rest", [20e-3, 10e-3, 22e-3 + FAR2 / 70e-3])
@pytest.mark.parametrize("unit", [1, 1e-3, 1e-6])
def test_distances_from_the_camera_are_refused(rest, unit):
    """As TACTO gives them; the membrane may bulge."""
    with pytest.raises(ImageError, match="as distances from the camera are: take them off those of the untouched gel"):
        read((rest - ball(8e-4)) / unit)
    if unit == 1e-6:
        with pytest.raises(ImageError, match="as distances from the camera are"):
            read(np.round((rest - ball(8e-4)) * 1e6).astype(np.uint16))


def test_sixteen_bits_count_micrometres():
    micrometres = np.round(ball(8e-4) * 1e6).astype(np.uint16)
    assert read(micrometres).warnings == []
    for scaled in (micrometres * 80, micrometres // 80):
        try:
            said = read(scaled).warnings[0]
        except ImageError as error:
            said = str(error)
        assert "16-bit" in said and "micrometres" in said


def test_eight_bits_have_no_unit():
    with pytest.raises(ImageError, match="got uint8; convert them: what one step of grey is, its maker says"):
        read((ball(8e-4) * 2e5).astype(np.uint8), "height")


@pytest.mark.parametrize("depth", [0.8e-4, 1.5e-4, 3e-4, 8e-4])
def test_pixels_given_as_millimetres_are_too_steep_or_too_deep(depth):
    """A factor of 15.8: what is deeper than the gel, or too steep for any object."""
    wedge = np.maximum(depth - np.abs(0.5 * PITCH * (COLUMNS - 160)), 0) * (abs(ROWS - 120) < 60)
    assert read(wedge).warnings == []
    said = "; ".join(read(1e-3 * wedge / PITCH).warnings)
    assert "if they are pixels times 0.001, multiply by 0.0634, pixel_pitch_mm" in said
    assert ("exceed the sensor's max_penetration_mm, 2" in said) != (
        "half of the contact is steeper than 72 degrees" in said
    )


@pytest.mark.parametrize("elastic", [False, True])
def test_no_simulated_depth_map_raises_a_doubt(elastic):
    warnings = []
    for name in ("elbow_pipe", "gear", "hex_nut"):  # whose contacts are the steepest
        space = ContactSpace(load_mesh(name), MINI)
        for T in space.sample(3, np.random.default_rng(4), (0.3e-3, 1.5e-3))[0]:
            depths_of(simulate_depth_map(space, T, elastic), name, MINI, warnings)
    step = np.where(ROWS < 120, 1.5e-3, 0)  # a sharp edge, as steep as the pixels allow
    depths_of(step, "step", MINI, warnings)
    assert warnings == []


def test_a_real_depth_map_raises_none(data_folder):
    height, pitch = read_scan(data_folder / "gelsight_groove_scan" / "heightmap.tmd")
    sensor, warnings = Sensor("bench", height.shape[::-1], pitch, 0.0, 1e-3), []
    depths_of(height - height.min(), "scan", sensor, warnings)
    assert warnings == []
