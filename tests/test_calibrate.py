"""Calibrating a user's sensor: presses of a ball of given diameter make colours measure slopes, heights, other balls."""

import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import geomtact
from geomtact import ImageError, InputError, Sensor, SensorError, UsageError, contact_height
from geomtact.cli import app
from geomtact.sensing.ball import diameter_of
from geomtact.sensing.calibrate import calibrate, calibrate_sensor, measured_diameter
from geomtact.sensing.colour import TERMS, ColourTable, fit_weights, terms
from geomtact.sensing.image_file import read_image, write_image
from geomtact.sensing.membrane import membrane_curvature
from geomtact.sensing.press import named_image

MM = 1e-3
SHAPE, PITCH = (120, 160), 0.1 * MM
SUNK = 0.15 * MM  # that the gel hangs below its rest at the contact's border
PLACES = [(40, 40), (80, 60), (120, 80), (60, 85), (105, 38), (45, 75)]
PLACES += [(25, 90), (100, 100), (130, 60), (75, 30), (60, 60), (95, 75)]


def pressed(diameter, centre, contact=1.6 * MM, bend=0.0):
    """Depth (H, W) [m] of a gel under a ball, and its slope (H, W, 2): the ball's shape, then an exponential rise. A membrane
    that bulges with radius ``bend`` has been that much nearer to the ball around its middle, which lies along its normal."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    off = (np.stack([u, v], -1) - centre) * PITCH
    far, ball = np.linalg.norm(off, axis=-1), diameter / 2
    if bend:
        middle = (np.array(centre) + 0.5 - np.array(SHAPE[::-1]) / 2) * PITCH
        off = off - middle * ((np.sqrt(bend**2 - contact**2) + np.sqrt(ball**2 - contact**2)) / bend - 1)
    steep = contact / np.sqrt(ball**2 - contact**2)
    r2 = np.minimum((off**2).sum(-1), 0.999 * ball**2)
    sphere = np.sqrt(ball**2 - r2) - np.sqrt(ball**2 - contact**2) + SUNK
    fall = SUNK * np.exp(-(far - contact) * steep / SUNK)
    inside = far < contact
    down = np.where(inside, -1 / np.sqrt(ball**2 - r2), -fall * steep / SUNK / np.maximum(far, 1e-9))
    slope = off * down[..., None]
    if bend:
        xy = (np.stack([u, v], -1) + 0.5 - np.array(SHAPE[::-1]) / 2) * PITCH
        slope = slope - np.where(inside, 1.0, 0.0)[..., None] * xy / np.sqrt(bend**2 - (xy**2).sum(-1, keepdims=True))
    return np.where(inside, sphere, fall), slope


def lit(slope, rng):
    """A tactile image (H, W, 3) of slopes (H, W, 2) under three lamps, nearer is brighter, over its background (H, W, 3)."""
    x, y = np.meshgrid(np.linspace(-1, 1, SHAPE[1]), np.linspace(-1, 1, SHAPE[0]))
    lamps = np.array([[0.35, 0.02], [-0.17, 0.3], [-0.16, -0.29]])
    near = np.stack([1 + 0.2 * x, 1 - 0.1 * x + 0.15 * y, 1 - 0.1 * x - 0.15 * y], -1)
    background = np.stack([0.45 + 0.05 * x, 0.4 - 0.03 * y, 0.5 + 0.02 * x * y], -1)
    change = near * (slope @ lamps.T)
    both = (np.clip(image + 0.002 * rng.normal(size=image.shape), 0, 1) for image in (background + change, background))
    return tuple(np.rint(255 * image).astype(np.uint8) for image in both)


def presses(diameter, places=PLACES, seed=0, bend=0.0):
    rng = np.random.default_rng(seed)
    made = [lit(pressed(diameter, place, bend=bend)[1], rng) for place in places]
    return [image for image, _ in made], made[0][1]


@pytest.fixture(scope="module")
def found():
    images, background = presses(8 * MM)
    return calibrate_sensor(images, 8 * MM, background, PITCH, name="made")


def test_an_opaque_alpha_channel_changes_nothing(tmp_path):
    """Files are read as everywhere else."""
    image, _ = presses(8 * MM, PLACES[:1])
    opaque = np.concatenate([image[0], np.full((*SHAPE, 1), 255, np.uint8)], -1)
    write_image(tmp_path / "rgba.png", opaque)
    name, read = named_image(tmp_path / "rgba.png", "press 1")
    assert name == str(tmp_path / "rgba.png") and np.array_equal(read, named_image(image[0], "press 1")[1])


def test_slopes_are_those_of_the_ball(found):
    assert len(found.presses) == len(PLACES) and not found.left_out
    for press, place in zip(found.presses, PLACES, strict=True):
        assert press.centre == pytest.approx(place, abs=1.0)
    assert np.median(found.diameters) == pytest.approx(8 * MM, rel=0.03)
    assert found.sensor.colour.slope_rms < 0.03


@pytest.mark.parametrize("diameter", [6 * MM, 12 * MM])
def test_heights_of_a_ball_it_was_not_calibrated_with(found, diameter):
    (image,), background = presses(diameter, [(90, 65)], seed=7)
    true, _ = pressed(diameter, (90, 65))
    height = contact_height(image, background, found.sensor)
    on = np.hypot(*(np.indices(SHAPE)[::-1] - np.array([90, 65])[:, None, None])) * PITCH < 1.2 * MM
    assert height.dtype == np.float32 and (height >= 0).all()
    assert height[on] == pytest.approx(true[on], abs=0.08 * true.max())
    assert contact_height(background, background, found.sensor).max() == 0


def test_a_bulging_membrane_takes_its_own_slope_off_the_balls():
    images, background = presses(8 * MM, bend=35 * MM)
    curved = Sensor("curved", SHAPE[::-1], (PITCH, PITCH), 0.0, 2 * MM, membrane_radius=35 * MM)
    found = calibrate_sensor(images, 8 * MM, background, sensor=curved)
    assert np.median(found.diameters) == pytest.approx(8 * MM, rel=0.03)
    # treated as flat, its bulge passes for a tenth of the ball's curvature
    flat = calibrate_sensor(images, 8 * MM, background, PITCH)
    press = found.presses[0]
    diameters = [measured_diameter(press, sensor) for sensor in (found.sensor, flat.sensor)]
    assert diameters[0] == pytest.approx(8 * MM, rel=0.05)
    assert np.linalg.norm(np.subtract(found.sensor.colour.weights, flat.sensor.colour.weights)) > 0.05


@pytest.mark.slow
def test_two_balls_measure_the_bulge_of_a_membrane():
    """The curvature comes out somewhat too small: imprints on a bulge are not quite round."""
    for bend in (0.0, 35 * MM, 100 * MM):
        found = []
        for diameter, seed in ((6 * MM, 1), (10 * MM, 2)):
            images, background = presses(diameter, seed=seed, bend=bend)
            found += [calibrate_sensor(images, diameter, background, PITCH), diameter]
        curvature, std = membrane_curvature(*found)
        if bend:
            assert 0.7 < curvature * bend < 1.1 and curvature > 3 * std
        else:
            assert abs(curvature) < 2.5 and std < 1
    with pytest.raises(InputError, match="determine nothing of the membrane"):
        membrane_curvature(*found[:3], 7 * MM)
    with pytest.raises(InputError, match="the balls contradict each other"):
        membrane_curvature(*found[:3], 20 * MM)
    swapped = [
        one
        for diameter, said in ((6 * MM, 10 * MM), (10 * MM, 6 * MM))
        for one in (calibrate_sensor(*presses(diameter)[:1], said, presses(diameter)[1], PITCH), said)
    ]
    with pytest.raises(InputError, match="be hollow.*not exchanged"):
        membrane_curvature(*swapped)


def test_presses_all_in_one_place_or_few_are_doubted():
    images, background = presses(8 * MM, [(40, 35), (70, 60), (50, 70)])
    said = calibrate_sensor(images, 8 * MM, background, PITCH).warnings
    assert "presses lie within 19 % of the window's width and 29 % of its height" in said[0]
    images, background = presses(8 * MM, PLACES[:3])
    assert any(
        "measure the ball" in warning for warning in calibrate_sensor(images, 8 * MM, background, PITCH).warnings
    )
    found = calibrate_sensor([*images, images[0]], 8 * MM, background, PITCH)
    assert found.left_out == {"press 4": "it is the same image as one before"}
    assert not any("no ball of that size" in warning for warning in found.warnings)
    untouched = [np.clip(background.astype(int) + n, 0, 255).astype(np.uint8) for n in range(4)]
    doubted = calibrate_sensor([*images, *images, *untouched], 8 * MM, background, PITCH).warnings
    assert "on 4 presses no ball of that size was found, on 3 it was" in doubted[0]


def test_a_pitch_with_which_imprints_are_wider_than_the_ball_is_doubted():
    """Of a ball of 4 mm, with one press of a larger among them, whose imprint has a radius of 2.4 mm."""
    rng = np.random.default_rng(0)
    made = [lit(pressed(4 * MM, place, contact=1.2 * MM)[1], rng) for place in PLACES]
    wide = lit(pressed(12 * MM, (80, 60), contact=2.4 * MM)[1], rng)[0]
    found = calibrate_sensor([*(image for image, _ in made), wide], 4 * MM, made[0][1], PITCH)
    assert "is wider than the ball" in found.left_out[f"press {len(PLACES) + 1}"]
    allowed = float(re.search(r"allows a pitch of ([0-9.]+) mm at most", found.warnings[0])[1])
    assert allowed * MM == pytest.approx(PITCH * 2.0 / 2.4, rel=0.1)


def test_a_press_of_another_ball_is_named(found):
    assert found.warnings == []
    images, background = presses(8 * MM)
    mixed = calibrate_sensor([*images, presses(14 * MM, PLACES[:1])[0][0]], 8 * MM, background, PITCH)
    assert any(f"on press {len(PLACES) + 1} no ball is seen, or one more than 40 %" in said for said in mixed.warnings)


def test_a_background_in_which_the_ball_is_pressed_in_is_refused_as_is_one_place_alone():
    images, background = presses(8 * MM, PLACES)
    with pytest.raises(
        InputError, match="nearly all presses differ from the background around column .* without contact"
    ):
        calibrate_sensor(images[1:], 8 * MM, images[0], PITCH)
    images, background = presses(8 * MM, [(70, 55), (73, 60), (76, 58)])
    with pytest.raises(InputError, match="or all presses lie there"):
        calibrate_sensor(images, 8 * MM, background, PITCH)


def test_large_images_take_no_more_memory_at_a_time(found):
    change = np.random.default_rng(0).normal(size=(150, 40, 3))
    v, u = np.mgrid[:150, :40]
    whole = terms(change.reshape(-1, 3), u.ravel(), v.ravel(), (150, 40)) @ np.array(found.sensor.colour.weights).T
    assert found.sensor.colour.slopes(change) == pytest.approx(whole.reshape(150, 40, 2), rel=1e-9, abs=1e-9)


def test_the_diameter_of_exact_slopes_is_exact():
    depth, slope = pressed(8 * MM, (80, 60))
    v, u = np.nonzero(depth > 0.6 * depth.max())
    assert diameter_of(np.stack([u, v], 1) * PITCH, slope[v, u]) == pytest.approx(8 * MM, rel=1e-9)


def test_weights_that_made_the_slopes_are_found_again(rng):
    change, u, v = rng.normal(size=(4000, 3)), rng.uniform(0, 159, 4000), rng.uniform(0, 119, 4000)
    features, weights = terms(change, u, v, SHAPE), rng.normal(size=(2, TERMS))
    assert features.shape == (4000, TERMS)
    assert fit_weights(features, features @ weights.T) == pytest.approx(weights, abs=5e-3)
    assert (terms(np.zeros((5, 3)), u[:5], v[:5], SHAPE) == 0).all()  # without a change of colour the gel is flat


def test_presses_of_unknown_depth_bound_the_pitch_but_do_not_measure_it():
    images, background = presses(8 * MM)
    with pytest.raises(UsageError, match=r"presses of unknown depth.*at most 0\.(\d+) mm") as error:
        calibrate(images, 8 * MM, background)
    bound = float(str(error.value).split("at most ")[1].split(" mm")[0]) * MM
    assert PITCH < bound < 4 * PITCH
    with pytest.raises(InputError, match="wider than the ball"):
        calibrate(images, 8 * MM, background, 1.05 * bound)


def test_what_is_no_ball_is_left_out_and_named(rng):
    images, background = presses(8 * MM)
    bar = np.zeros((*SHAPE, 2))
    bar[30:40, 20:140, 1], bar[80:90, 20:140, 1] = 0.5, -0.5
    images = [background, lit(bar, rng)[0], *images[:3]]
    found = calibrate_sensor(images, 8 * MM, background, PITCH)
    assert set(found.left_out) == {"press 1", "press 2"} and "no contact" in found.left_out["press 1"]
    with pytest.raises(InputError, match=r"3 presses or more are needed, 2 of 4 serve \(press 1: no contact"):
        calibrate(images[:4], 8 * MM, background, PITCH)


def test_a_sensor_file_keeps_the_colours_and_its_indexes(found, tmp_path):
    sensor = found.sensor
    again = Sensor.from_toml(sensor.to_toml())
    assert again == sensor and again.colour.weights == pytest.approx(np.array(sensor.colour.weights), rel=1e-8)
    assert again.to_toml() == sensor.to_toml()
    # colours change nothing that an index is made of
    assert sensor.sha256 == replace(sensor, colour=None).sha256
    text = sensor.to_toml()
    for wrong, what in (
        (text.replace("slope_rms", "slope_rmz"), "unknown key 'slope_rmz'.*slope_rms"),
        (text.replace("height_rms_mm = ", "# "), "'height_rms_mm' is missing"),
        (text[: text.index("weights")] + "weights = [[1, 2], [3, 4]]\n", f"2 x {TERMS}"),
        (text[: text.index("weights")] + 'weights = "many"\n', "must hold numbers"),
        (text.replace("slope_rms = ", "slope_rms = -"), ">= 0"),
        (text.replace("slope_rms = ", "slope_rms = true #"), "must hold numbers"),
        (text.replace("slope_rms = ", "slope_rms = 1" + 400 * "0" + " # "), "must hold numbers"),
        (text[: text.index("weights")] + "weights = " + 5000 * "[" + 5000 * "]", "lists within lists|not valid TOML"),
    ):
        with pytest.raises(SensorError, match=what):
            Sensor.from_toml(wrong, "made.toml")


def test_missing_and_wrong_entries_are_named(found):
    images, background = presses(8 * MM)
    with pytest.raises(SensorError, match="not calibrated.*geomtact calibrate"):
        contact_height(images[0], background, replace(found.sensor, colour=None))
    with pytest.raises(ImageError, match="expected the size of the image"):
        contact_height(images[0], background[:-1], found.sensor)
    with pytest.raises(ImageError, match="expected 160 x 120 px for sensor made .width x height., got 80 x 60"):
        contact_height(images[0][::2, ::2], background[::2, ::2], found.sensor)
    with pytest.raises(ImageError, match="press 2: expected the size of the background, 160 x 120 px, got 160 x 119"):
        calibrate([images[0], images[1][:-1], images[2]], 8 * MM, background, PITCH)
    with pytest.raises(UsageError, match="expected a list of 3 images or more, got one path"):
        calibrate("press.png", 8 * MM, background, PITCH)
    with pytest.raises(UsageError, match=r"expected metres.*6\.31 mm is 0\.00631"):
        calibrate(images, 8, background, PITCH)
    with pytest.raises(UsageError, match="pixel_pitch: expected metres"):
        calibrate(images, 8 * MM, background, 0.1)
    with pytest.raises(
        ImageError, match="expected 320 x 240 px for sensor gelsight-mini .width x height., got 160 x 120"
    ):
        calibrate(images, 8 * MM, background, sensor="gelsight-mini")
    with pytest.raises(SensorError, match="weights"):
        ColourTable(((0.0,) * 3, (0.0,) * TERMS), 0, 0, 0)


def test_the_command_writes_a_sensor_and_a_picture(tmp_path):
    images, background = presses(8 * MM)
    names = [tmp_path / f"{k}.png" for k in range(len(images))]
    for name, image in zip([*names, tmp_path / "background.png"], [*images, background], strict=True):
        write_image(name, image)

    def run(*words):
        given = ["--background", tmp_path / "background.png", "--ball-mm", 8, "--out", tmp_path / "mine.toml"]
        return CliRunner().invoke(app, [str(w) for w in ("calibrate", *names, *given, *words)])

    result = run("--pitch-mm", 0.1, 0.1, "--plot", tmp_path / "fit.png")
    assert result.exit_code == 0, result.output
    assert "12 of 12 presses used" in result.output and "given 8 mm" in result.output
    sensor = Sensor.load(tmp_path / "mine.toml")
    assert sensor.name == "mine" and sensor.pixel_pitch == pytest.approx((PITCH, PITCH))
    assert read_image(tmp_path / "fit.png").ndim == 3
    height = geomtact.contact_height(images[0], background, tmp_path / "mine.toml")
    assert height.max() == pytest.approx(pressed(8 * MM, PLACES[0])[0].max(), rel=0.1)
    options = ["--ball-mm", "8", "--background", str(tmp_path / "background.png")]
    folder = CliRunner().invoke(app, ["calibrate", str(tmp_path), *options])
    assert folder.exit_code == 2 and "expected images, got a folder; give" in folder.output
    other = tmp_path / "other"
    other.mkdir()
    for k, image in enumerate(presses(12 * MM)[0]):
        write_image(other / f"{k}.png", image)
    both = run("--pitch-mm", 0.1, 0.1, "--other-presses", other, "--other-ball-mm", 12)
    assert both.exit_code == 0 and "membrane is flat" in both.output, both.output
    assert "belong together" in run("--pitch-mm", 0.1, 0.1, "--other-ball-mm", 12).output
    assert "at most" in run().output and run().exit_code == 2
    assert "expected 0.001 to 1 millimetres" in run("--pitch-mm", 1e-4, 1e-4).output
    assert "no folder" in run("--out", tmp_path / "no" / "mine.toml").output
    assert "ends in .toml" in run("--out", tmp_path / "mine.txt").output


@pytest.mark.parametrize(("used", "measured"), [(6.310, 9.500), (9.500, 6.310)])
@pytest.mark.slow
def test_real_presses_of_one_ball_measure_the_other(data_folder, used, measured):
    folder = data_folder / "gelslam_gsmini_balls"
    own, other = (sorted((folder / f"{d:.3f}mm").glob("*.png")) for d in (used, measured))
    background = folder / "background.png"
    table = calibrate_sensor(own, used * MM, background, sensor="gelsight-mini")
    assert np.median(table.diameters) == pytest.approx(used * MM, rel=0.05)
    assert len(table.presses) >= 0.8 * len(own)
    found = calibrate_sensor(other, measured * MM, background, sensor="gelsight-mini").presses
    diameters = [measured_diameter(press, table.sensor) for press in found]
    assert np.median(diameters) == pytest.approx(measured * MM, rel=0.05)
