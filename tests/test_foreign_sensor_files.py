"""Sensor files of gs_sdk, TACTO and gsrobotics."""

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from geomtact import ImageError, Sensor, SensorError
from geomtact.cli.frames import camera_frames
from geomtact.sensing.reading import read_observation

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
# as the GelSight Mini's software keeps it, with other values
GSROBOTICS = {
    "default_camera_index": 0,
    "camera_width": 640,
    "camera_height": 480,
    "border_fraction": 0.1,
    "marker_mask_min": 5,
    "nn_model_path": "./net.pt",
    "use_gpu": False,
}


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


def test_the_digit_of_tacto_has_the_bundled_digits_camera_and_dome(data_folder):
    theirs, ours = Sensor.load(data_folder / "tacto_digit" / "config_digit.yml"), Sensor.load("digit")
    assert theirs.camera_distance == pytest.approx(ours.camera_distance)
    assert theirs.membrane_radius == pytest.approx(ours.membrane_radius, rel=0.01)
    assert theirs.image_size_px == ours.image_size_px


@pytest.mark.parametrize("name", ["mine.YAML", "mine.Yml", "MINE.YML"])
def test_the_case_of_a_suffix_does_not_matter(tmp_path, name):
    assert Sensor.load(written(tmp_path, GS_SDK, name)).name == "Mini"
    assert Sensor.load(written(tmp_path, Sensor.load("digit").to_toml(), "D.TOML")) == Sensor.load("digit")
    with pytest.raises(SensorError, match="no such file"):
        Sensor.load(tmp_path / "absent.YAML")


def test_a_file_of_gsrobotics_shows_its_crop_of_the_minis_frame(tmp_path):
    """The frame is as large as the bundled sensor's, which shows 5/7 of it; the pixels differ."""
    mini, theirs = Sensor.load("gelsight-mini"), Sensor.load(written(tmp_path, json.dumps(GSROBOTICS), "config.JSON"))
    assert theirs.name == "config" and theirs.image_size_px == (640, 480) and theirs.border_fraction == 0.1
    np.testing.assert_allclose(theirs.half_window / 0.8, mini.half_window / (5 / 7), rtol=1e-5)
    assert theirs.camera_distance == mini.camera_distance and theirs.max_penetration == mini.max_penetration
    standard = GSROBOTICS | {"camera_width": 320, "camera_height": 240, "border_fraction": 0.15}
    theirs = Sensor.load(written(tmp_path, json.dumps(standard, indent="\t"), "config.json"))
    assert theirs.pixel_pitch == pytest.approx((0.0621e-3, 0.0621e-3), abs=1e-7)
    assert Sensor.from_toml(theirs.to_toml()) == theirs
    assert Sensor.from_toml(theirs.to_toml()).border_fraction == 0.15


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (
            {"camera_width": None},
            "the key 'camera_width' is missing; gsrobotics writes camera_width, camera_height, bord",
        ),
        ({"border_fraction": None}, "the key 'border_fraction' is missing"),
        ({"camera_height": 240.5}, "camera_width and camera_height must be whole numbers > 0, got 640 and 240.5"),
        ({"camera_height": 0}, "whole numbers > 0, got 640 and 0"),
        ({"border_fraction": 15}, "border_fraction is the share cut off at each side, 0 to 0.49, got 15"),
        ({"border_fraction": float("nan")}, "0 to 0.49, got nan"),
        ({"border_fraction": "a"}, "what this one holds is not valid"),
    ],
)
def test_an_error_in_a_file_of_gsrobotics_is_named(tmp_path, wrong, expected):
    text = json.dumps({key: value for key, value in (GSROBOTICS | wrong).items() if value is not None})
    with pytest.raises(SensorError, match=expected) as error:
        Sensor.load(written(tmp_path, text, "config.json"))
    assert "\n" not in str(error.value) and "config.json" in str(error.value)


@pytest.mark.parametrize("text", ["{", "[1]", '{"T_world_sensor": []}', "[" * 9999])
def test_other_json_is_no_sensor(tmp_path, text):
    with pytest.raises(
        SensorError, match="expected one of gs_sdk .* or one of gsrobotics with camera_width, camera_height"
    ):
        Sensor.load(written(tmp_path, text, "poses.json"))


@pytest.mark.parametrize(
    ("size", "kept"),
    [
        ((640, 480), "rows 68 to 411 and columns 91 to 548"),
        ((3280, 2464), "rows 352 to 2111 and columns 468 to 2811"),
        ((1640, 1232), "rows 176 to 1055 and columns 234 to 1405"),
    ],
)
def test_a_whole_frame_of_the_mini_is_refused_with_its_valid_crop(size, kept):
    """gs_sdk cuts off a seventh of 640 x 480 and of 3280 x 2464 px, in whole pixels, as here."""
    frame = np.random.default_rng(0).integers(0, 255, (*size[::-1], 3), np.uint8)
    message = (
        f"image: expected 320 x 240 px for sensor gelsight-mini (width x height), got {size[0]} x {size[1]} px; cut the camera's "
        f"whole frame to {kept}, counted from 0, and scale it to 320 x 240 px; if it is cut already, only scale it"
    )
    with pytest.raises(ImageError) as error:
        read_observation(frame, "gelsight-mini")
    assert str(error.value) == message
    with pytest.raises(ImageError, match="name the sensor that took it"):
        read_observation(frame[:, : size[0] // 2], "gelsight-mini")


@pytest.mark.parametrize("size", [(320, 240), (640, 480), (3280, 2464)])
def test_a_live_frame_is_cut_as_the_sensors_images_are(monkeypatch, size):
    """Whatever the camera's resolution: the corners of the image lie a seventh within those of the frame."""
    columns, rows = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    frame = np.stack([0 * rows, 255 * rows, 255 * columns], -1).astype(np.uint8)  # BGR

    class Capture:
        def __init__(self, *_):
            self.left = 3

        def read(self):
            self.left -= 1
            return self.left >= 0, frame

        def __getattr__(self, name):
            return lambda *_: True

    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    image = next(camera_frames("0", Sensor.load("gelsight-mini"))).image
    assert image.shape == (240, 320, 3)
    np.testing.assert_allclose(image[0, 0, :2], 255 / 7, atol=3)
    np.testing.assert_allclose(image[-1, -1, :2], 255 * 6 / 7, atol=3)
    assert next(camera_frames("0")).image.shape == frame.shape
    # cut before it is turned, so of the camera's aspect, not of the sensor's
    mounted = replace(Sensor.load("gelsight-mini"), image_size_px=(240, 320), camera_rotation_deg=90)
    turned = next(camera_frames("0", mounted)).image
    assert np.array_equal(turned, image) and mounted.upright(turned).shape == (320, 240, 3)


def test_a_live_frame_of_another_aspect_is_refused(monkeypatch):
    """A wide frame, squeezed to the sensor's size, would show every contact too narrow."""
    monkeypatch.setattr("geomtact.cli.frames._next_rgb", lambda capture: np.zeros((720, 1280, 3), np.uint8))
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: SimpleNamespace(isOpened=lambda: True))
    with pytest.raises(ImageError, match="expected 320 x 240 px"):
        camera_frames("0", Sensor.load("gelsight-mini"))


def test_it_may_be_written_out_as_toml(tmp_path):
    sensor = Sensor.load(written(tmp_path, GS_SDK))
    assert Sensor.from_toml(sensor.to_toml()) == sensor


@pytest.mark.parametrize(
    ("text", "expected"),
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
        ("ppmm: 0.06\nimgw: 320\nimgh: on", "whole numbers, got 320 and True"),
        ("ppmm: yes\nimgw: 320\nimgh: 240", "expected a number, got True"),
        (
            TACTO.replace("yfov: 90", "yfov: 1.047") % "True",
            "yfov is in degrees in TACTO, 3.2 to 180, got 1.047; of radians give 59.99",
        ),
        (TACTO.replace("yfov: 90", "yfov: 180") % "True", "yfov is in degrees in TACTO, 3.2 to 180, got 180"),
        (TACTO.replace("yfov: 90", "yfov: -60") % "True", "yfov is in degrees in TACTO, 3.2 to 180, got -60"),
        (TACTO.replace("yfov: 90", "yfov: yes") % "True", "expected a number, got True"),
        (TACTO.replace("width: 0.03", "width: on") % "True", "expected a number, got True"),
        ("ppmm: !!bool x", "not valid YAML"),
        ("ppmm: !!timestamp abc", "not valid YAML"),
        (TACTO.replace("    - cam0:", "    - cam0:\n    - cam1:") % "True", "is not valid|one camera"),
        (TACTO.replace("width: 0.03", "mesh: gel.obj") % "True", "expected one camera before a flat or spherical gel"),
        (TACTO.replace("0.02, 0", "-0.02, 0") % "True", "the gel before the camera"),
        ("ppmm: .nan\nimgw: 320\nimgh: 240", "pixel_pitch_mm must be positive"),
        ("!!python/object/apply:os.system ['true']", "not valid YAML"),
    ],
)
def test_a_faulty_sensor_file_is_one_line(tmp_path, text, expected):
    with pytest.raises(SensorError, match=expected) as error:
        Sensor.load(written(tmp_path, text))
    assert "\n" not in str(error.value) and "mine.yaml" in str(error.value)


@pytest.mark.parametrize(
    "length", [{"pixel_pitch": (np.inf, 1e-4)}, {"camera_distance": np.inf}, {"membrane_radius": np.inf}]
)
def test_a_length_without_end_is_refused(length):
    with pytest.raises(SensorError, match="a length is infinite"):
        replace(Sensor.load("digit"), **length)
