"""Sensor files of gs_sdk and TACTO."""

from dataclasses import replace

import numpy as np
import pytest

from geomtact import Sensor, SensorError

GS_SDK = "device_name: Mini\nimgw: 320\nimgh: 240\nppmm: 0.0634\nframerate: 25\n"
TACTO = """
sensor:
  camera:
    - cam0:
      position: [0, 0, 0.01]
      orientation: [90, 0, -90]
      yfov: 90
  gel: {origin: [0.02, 0, 0.01], width: 0.03, height: 0.04, curvature: %s, curvatureMax: 0.005}
"""


def written(tmp_path, text, name="mine.yaml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_a_file_of_gs_sdk_gives_the_pitch_in_millimetres_per_pixel(tmp_path):
    sensor = Sensor.load(written(tmp_path, GS_SDK))
    assert sensor.name == "Mini" and sensor.image_size_px == (320, 240)
    np.testing.assert_allclose(2 * sensor.half_window, [320 * 0.0634e-3, 240 * 0.0634e-3])
    assert sensor.camera_distance == 0 and sensor.membrane_radius == 0


def test_a_file_of_tacto_gives_the_window_that_its_camera_sees(tmp_path):
    sensor = Sensor.load(written(tmp_path, TACTO % "True"))
    assert sensor.camera_distance == pytest.approx(0.02)
    # 90 degrees at 20 mm: 40 mm high
    np.testing.assert_allclose(2 * sensor.half_window, [30e-3, 40e-3])
    assert sensor.sag(15e-3, 20e-3) == pytest.approx(5e-3), "the dome falls by curvatureMax to the gel's corners"
    flat = Sensor.load(written(tmp_path, TACTO % "False", "flat.yml"))
    assert flat.membrane_radius == 0 and flat.name == "flat"


def test_tactos_own_digit_has_the_bundled_digits_camera_and_dome(data_folder):
    theirs, ours = Sensor.load(data_folder / "tacto_digit" / "config_digit.yml"), Sensor.load("digit")
    assert theirs.camera_distance == pytest.approx(ours.camera_distance)
    assert theirs.membrane_radius == pytest.approx(ours.membrane_radius, rel=0.01)
    assert theirs.image_size_px == ours.image_size_px


def test_it_may_be_written_out_as_toml(tmp_path):
    sensor = Sensor.load(written(tmp_path, GS_SDK))
    assert Sensor.from_toml(sensor.to_toml()) == sensor


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x: {", "not valid YAML"),
        ("foo: 1", "expected one of gs_sdk with ppmm, imgw and imgh, or one of TACTO"),
        ("- 1", "expected one of gs_sdk"),
        ("ppmm: 0.06\nimgw: 320", "is not valid \\('imgh'\\)"),
        ("ppmm: [1]\nimgw: 320\nimgh: 240", "is not valid"),
        ("ppmm: -1\nimgw: 320\nimgh: 240", "pixel_pitch_mm must be positive"),
        ("sensor: {camera: [], gel: {}}", "expected one camera"),
        ("sensor: {camera: [{position: [0, 0], yfov: 60}], gel: {origin: [0, 0, 1]}}", "the gel before the camera"),
        ("ppmm: .inf\nimgw: 320\nimgh: 240", "millimetres per pixel"),
        ("ppmm: 15.8\nimgw: 320\nimgh: 240", "millimetres per pixel in gs_sdk, and 15.8 are too many"),
        ("ppmm: 0.06\nimgw: 320.7\nimgh: 240", "whole numbers, got 320.7"),
        ("ppmm: !!bool x", "not valid YAML"),
        ("ppmm: !!timestamp abc", "not valid YAML"),
        (TACTO.replace("    - cam0:", "    - cam0:\n    - cam1:") % "True", "is not valid|one camera"),
        (TACTO.replace("width: 0.03", "mesh: gel.obj") % "True", "expected one camera before a flat or spherical gel"),
        (TACTO.replace("0.02, 0", "-0.02, 0") % "True", "the gel before the camera"),
        ("ppmm: .nan\nimgw: 320\nimgh: 240", "pixel_pitch_mm must be positive"),
        ("!!python/object/apply:os.system ['true']", "not valid YAML"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(tmp_path, text, told):
    with pytest.raises(SensorError, match=told) as error:
        Sensor.load(written(tmp_path, text))
    assert "\n" not in str(error.value) and "mine.yaml" in str(error.value)


@pytest.mark.parametrize(
    "length", [{"pixel_pitch": (np.inf, 1e-4)}, {"camera_distance": np.inf}, {"membrane_radius": np.inf}]
)
def test_a_length_without_end_is_refused(length):
    with pytest.raises(SensorError, match="a length is infinite"):
        replace(Sensor.load("digit"), **length)
