"""A depth map in another unit, or from another zero, is refused with the conversion that it needs; a right one passes."""

import re

import numpy as np
import pytest

from geomtact import load_mesh
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import felt_height
from geomtact.errors import ImageError
from geomtact.evaluation.groove import read_scan
from geomtact.sensing.depth_map import depths_of
from geomtact.sensing.reading import read_observation
from geomtact.sensing.sensor import Sensor

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
    ],
)
def test_another_unit_is_refused_with_its_conversion(depth, unit, conversion):
    """Of the conversions that are named, one is right, and each makes a touch that the gel can feel."""
    given = ball(depth) / unit
    for array in (given, given.astype(np.float32)):
        with pytest.raises(ImageError, match=re.escape(conversion)) as error:
            read(array)
        assert "expected heights in metres up to about 0.002" in str(error.value) and "\n" not in str(error.value)
    for factor in re.findall(r" by ([\d.e-]+)", str(error.value)):
        assert 0.01 * 2e-3 <= float(factor) * given.max() <= 1.5 * 2e-3


def test_the_message_for_gs_sdks_pixels():
    with pytest.raises(ImageError) as error:
        read(ball(5e-4) / PITCH)
    assert str(error.value) == (
        "image: expected heights in metres up to about 0.002, the largest is 7.886; multiply pixels (of gs_sdk) by "
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
    for part in ("elbow_pipe", "gear", "hex_nut"):  # whose contacts are the steepest
        space = ContactSpace(load_mesh(part), MINI)
        for T in space.sample(3, np.random.default_rng(4), (0.3e-3, 1.5e-3))[0]:
            depths_of(felt_height(space, T, elastic), part, MINI, warnings)
    step = np.where(ROWS < 120, 1.5e-3, 0)  # a sharp edge, as steep as the pixels allow
    depths_of(step, "step", MINI, warnings)
    assert warnings == []


def test_a_real_depth_map_raises_none(data_folder):
    height, pitch = read_scan(data_folder / "gelsight_groove_scan" / "heightmap.tmd")
    sensor, warnings = Sensor("bench", height.shape[::-1], pitch, 0.0, 1e-3), []
    depths_of(height - height.min(), "scan", sensor, warnings)
    assert warnings == []
