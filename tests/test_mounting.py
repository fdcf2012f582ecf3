"""Neither a sensor's mounting nor flickering light changes the contact."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from speed import slow_but
from typer.testing import CliRunner

from geomtact import ImageError, Sensor, SensorError, calibrate, contact_height, contact_mask
from geomtact.cli import app
from geomtact.sensing.change import smooth_background
from geomtact.sensing.flicker import without_flicker
from geomtact.sensing.image_file import read_image, write_image
from geomtact.sensing.reading import read_observation
from geomtact.sensing.render import Lamps, render

SHAPES = [(240, 320), (320, 240), (240, 240), (123, 161)]
PITCH = 6e-5
METHODS = ("classical", "pressure", "learned")


def pressed(shape, rng):
    """How deep (H, W) [m] a gel is pressed in by a ball, a bar and a block, or some of them."""
    h, w = shape
    y, x = np.mgrid[:h, :w] * PITCH - 0.5 * PITCH * np.array(shape)[:, None, None]
    depth = np.zeros(shape)
    for kind in rng.permutation(3)[: rng.integers(1, 3)]:
        at, angle = rng.uniform(-0.3, 0.3, 2) * np.array(shape) * PITCH, rng.uniform(0, np.pi)
        u = (x - at[1]) * np.cos(angle) + (y - at[0]) * np.sin(angle)
        v = (y - at[0]) * np.cos(angle) - (x - at[1]) * np.sin(angle)
        deep, radius, long, wide = rng.uniform((3e-4, 2e-3, 1.5e-3, 1e-3), (1e-3, 4e-3, 4e-3, 3e-3))
        across = u**2 + (v**2 if kind == 0 else 0)
        round_ = deep - radius + np.sqrt(np.maximum(radius**2 - across, 0))
        below = (round_, np.where(abs(v) < long, round_, 0), np.where((abs(u) < wide) & (abs(v) < long), deep, 0))[kind]
        depth = np.maximum(depth, below)
    return cv2.GaussianBlur(np.maximum(depth, cv2.GaussianBlur(depth, (0, 0), 6)), (0, 0), 2)


def reading(depth, rng):
    """An image and its background (H, W, 3) of uint8, under three lamps that stand anyhow."""
    lamps, (h, w) = Lamps.around(rng.uniform(0, 2 * np.pi)), depth.shape
    x, y = np.meshgrid(np.linspace(-1, 1, w), np.linspace(-1, 1, h))
    nearer = np.einsum("hwk,ck->hwc", np.stack([x, y], -1), -lamps.response[..., 0])
    rest = 0.45 * (1 - 0.2 * (x**2 + y**2))[..., None] * (1 + 0.4 * nearer)
    noise = rng.choice([0, 1, 3]) / 255
    both = (each + noise * rng.normal(size=rest.shape) for each in (render(depth, (PITCH, PITCH), rest, lamps), rest))
    return tuple(np.rint(255 * np.clip(each, 0, 1)).astype(np.uint8) for each in both)


def turned(image, quarters, mirrored):
    return np.ascontiguousarray(np.rot90(image[:, ::-1] if mirrored else image, quarters))


def overlap(a, b):
    return (a & b).sum() / max((a | b).sum(), 1) if (a | b).any() else 1.0


@pytest.fixture(scope="module")
def simulated():
    """100 images with their backgrounds."""
    rng = np.random.default_rng(45)
    return [reading(pressed(SHAPES[i % 4], rng), rng) for i in range(100)]


@pytest.fixture(scope="module")
def real(data_folder):
    """For each set of real tactile images, its background and every fourth image."""

    def read(path):
        return read_image(path)[..., :3]

    gelslam, fots = data_folder / "gelslam_gsmini_balls", data_folder / "fots_balls"
    board, hsp = data_folder / "ninedtact_calib" / "sensor_1", data_folder / "hsp_digit_sim_ycb"
    named = {
        "gelslam": (gelslam / "background.png", sorted(gelslam.glob("*mm/*.png"))),
        "gelsight": (fots / "gelsight_bg.png", sorted((fots / "gelsight").glob("*.png"))),
        "digit": (fots / "digit_bg.png", sorted((fots / "digit").glob("*.png"))),
        "9dtact": (board / "depth_calibration" / "ref.png", [board / "depth_calibration" / "sample.png"]),
        "pins": (board / "camera_calibration" / "ref.png", [board / "camera_calibration" / "sample.png"]),
        "hsp": (hsp / "background.png", sorted(hsp.glob("*/*/Image_heatmap_*.png"))),
    }
    found = {name: (read(rest), [read(each) for each in images[::4]]) for name, (rest, images) in named.items()}
    with np.load(data_folder / "objectfolder_gelsight_calib" / "dataPack_subset.npz", allow_pickle=False) as pack:
        return found | {"objectfolder": (pack["f0"], list(pack["imgs"][::4]))}


def agreements(pairs, method, seed):
    """How much the contact overlaps that of each pair when both images are turned and mirrored in one of seven orientations."""
    rng, out = np.random.default_rng(seed), []
    for image, rest in pairs:
        way = divmod(int(rng.integers(1, 8)), 2)
        seen = contact_mask(turned(image, *way), turned(rest, *way), method=method)
        out.append(overlap(seen, turned(contact_mask(image, rest, method=method), *way)))
    return np.array(out)


@pytest.mark.parametrize("method", METHODS)
def test_the_contact_turns_with_the_images(simulated, method):
    some = simulated if method != "learned" else simulated[:32]
    assert min(agreements(some, method, 1)) >= 0.97


@pytest.mark.parametrize("method", slow_but(METHODS, "classical"))
def test_the_contact_turns_with_real_images(real, method):
    for name, (rest, images) in real.items():
        assert min(agreements([(image, rest) for image in images], method, 2)) >= 0.97, name


def test_without_a_background_too(simulated):
    for image, _ in simulated[:12]:
        masks = [contact_mask(each) for each in (image, turned(image, 1, True))]
        assert overlap(turned(masks[0], 1, True), masks[1]) >= 0.97


def striped(image, share, bands, phase, along_rows=True):
    """``image`` (H, W, 3) whose rows, or columns, get brighter and darker by a ``share``."""
    n = image.shape[0 if along_rows else 1]
    gain = 1 + share * np.sin(2 * np.pi * bands * np.arange(n) / n + phase)
    gain = gain[:, None, None] if along_rows else gain[:, None]
    return np.rint(np.clip(image * gain, 0, 255)).astype(np.uint8)


def random_stripes(rng):
    return {"bands": rng.uniform(2, 20), "phase": rng.uniform(0, 2 * np.pi), "along_rows": bool(rng.integers(2))}


def unit(image):
    return (image / 255).astype(np.float32)


@pytest.mark.parametrize("share", slow_but([0.02, 0.05, 0.1, 0.2], 0.02, 0.2))
@pytest.mark.parametrize("method", METHODS)
def test_stripes_of_light_are_no_contact_and_hide_none(simulated, share, method):
    rng, kept = np.random.default_rng(3), []
    for image, rest in simulated[:: 5 if method != "learned" else 10]:
        stripes = random_stripes(rng)
        assert not contact_mask(striped(rest, share, **stripes), rest, method=method).any()
        found = contact_mask(striped(image, share, **stripes), rest, method=method)
        kept.append(overlap(found, contact_mask(image, rest, method=method)))
    assert np.median(kept) > 0.97 and np.mean(np.array(kept) > 0.9) >= 0.9


def test_stripes_of_a_twentieth_are_evened_out_on_real_images(real):
    """On gels in coloured light; in white light, where a contact is as grey, they are warned of."""
    rng = np.random.default_rng(4)
    for name, (rest, images) in real.items():
        white = name in ("9dtact", "pins")
        stripes = striped(rest, 0.05, **random_stripes(rng))
        untouched = without_flicker(unit(stripes), unit(rest))
        assert untouched.stripes and bool(untouched.unsure) == white, name
        assert white or not contact_mask(stripes, rest).any(), name
        if name == "hsp":  # of another simulator: contacts over most of a gel that bulges
            continue
        assert all(
            without_flicker(unit(striped(image, 0.05, **random_stripes(rng))), unit(rest)).stripes for image in images
        )


@pytest.mark.slow
def test_steady_light_is_left_as_it_is(real, simulated):
    for rest, images in [*real.values(), *((rest, [image]) for image, rest in simulated)]:
        for image in images:
            light = without_flicker(unit(image), unit(rest))
            assert light.stripes == 0 and light.warnings == [] and np.array_equal(light.image, unit(image))
            assert without_flicker(unit(image), smooth_background(unit(image)), estimated=True).stripes == 0


def test_flickering_light_is_a_warning_of_the_tactile_image(real):
    rest, images = real["gelslam"]
    image = striped(images[0], 0.05, bands=5, phase=1)
    seen = read_observation(image, "gelsight-mini", "reading", rest)
    (warning,) = seen.warnings
    assert "the light flickers" in warning and "3.5 % rms" in warning
    plain = read_observation(images[0], "gelsight-mini", "reading", rest)
    assert plain.warnings == [] and overlap(seen.contact.mask, plain.contact.mask) > 0.97
    untouched = read_observation(striped(rest, 0.05, bands=5, phase=1), "gelsight-mini", "reading", rest)
    assert not untouched.contact.mask.any()


MOUNTINGS = [(turn, mirrored) for turn in (0, 90, 180, 270) for mirrored in (False, True)]


def mounted(sensor, turn, mirrored):
    return replace(Sensor.load(sensor), camera_rotation_deg=turn, camera_mirrored=mirrored)


def as_camera(image, turn, mirrored):
    """What a camera so mounted delivers of an ``image`` in the sensor frame."""
    image = np.rot90(image, -turn // 90)
    return np.ascontiguousarray(image[:, ::-1] if mirrored else image)


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_a_mounted_camera_shows_the_same_contact(simulated, mounting, tmp_path):
    image, rest = simulated[0]
    sensor = mounted("gelsight-mini", *mounting)
    assert Sensor.from_toml(sensor.to_toml()) == sensor and Sensor.from_toml(sensor.to_toml()).turned == sensor.turned
    seen, background = (as_camera(each, *mounting) for each in (image, rest))
    assert np.array_equal(sensor.upright(seen), image)
    plain = read_observation(image, "gelsight-mini", background=rest).contact.mask
    assert plain.any() and np.array_equal(contact_mask(seen, background, sensor), plain)
    write_image(tmp_path / "seen.png", seen)
    for each in (seen, tmp_path / "seen.png"):
        observed = read_observation(each, sensor, background=background)
        assert np.array_equal(observed.contact.mask, plain) and np.array_equal(observed.image, image)
        assert observed.warnings == []


def test_masks_are_in_the_sensor_frame_unless_the_sensor_file_states_another(simulated, tmp_path):
    sensor = mounted("gelsight-mini", 180, True)
    mask = contact_mask(*simulated[0], "gelsight-mini")
    assert np.array_equal(read_observation(mask, sensor).contact.mask, mask)
    write_image(tmp_path / "mask.png", mask)
    observed = read_observation(tmp_path / "mask.png", sensor)
    assert np.array_equal(observed.contact.mask, mask) and "camera_masks" in observed.warnings[0]
    all_turned = replace(sensor, camera_masks=True)
    seen = as_camera(mask, 180, True)
    assert np.array_equal(read_observation(seen, all_turned).contact.mask, mask)
    # what simulate writes is in the sensor frame for sure
    write_image(tmp_path / "made.png", mask, {"sensor": "gelsight-mini"})
    made = read_observation(tmp_path / "made.png", all_turned)
    assert np.array_equal(made.contact.mask, mask)
    (warning,) = made.warnings
    assert "is not turned or mirrored as the camera is mounted" in warning
    assert read_observation(tmp_path / "made.png", "gelsight-mini").warnings == []


def test_an_invalid_turn_is_refused():
    text = Sensor.load("gelsight-mini").to_toml()
    for line, what in (("camera_rotation_deg = 45", "0, 90, 180 or 270"), ('camera_mirrored = "no"', "true or false")):
        with pytest.raises(SensorError, match=what):
            Sensor.from_toml(f"{text}{line}\n")
    with pytest.raises(ImageError, match="image_size_px is that after it"):
        read_observation(
            np.zeros((240, 320, 3), np.uint8) + np.arange(3, dtype=np.uint8), mounted("gelsight-mini", 90, False)
        )


def test_images_of_a_digit_are_turned_as_by_its_driver(real):
    """digit_interface transposes a frame, then flips it top to bottom: a quarter turn counter-clockwise."""
    rest, images = real["digit"]
    sensor = Sensor.load("digit")
    for upright in (rest, images[0]):
        raw = np.ascontiguousarray(np.rot90(upright, -1))
        assert raw.shape == (240, 320, 3)
        assert np.array_equal(cv2.flip(cv2.transpose(raw), 0), upright)
        assert np.array_equal(sensor.upright(raw), upright) and np.array_equal(sensor.upright(upright), upright)
    raw, background = (np.ascontiguousarray(np.rot90(each, -1)) for each in (images[0], rest))
    seen = read_observation(raw, sensor, background=background)
    plain = read_observation(images[0], sensor, background=rest)
    assert plain.warnings == [] and plain.contact.mask.any()
    assert np.array_equal(seen.contact.mask, plain.contact.mask)
    assert all("straight from the camera: turned by 90 degrees counter-clockwise" in each for each in seen.warnings)
    # a mask that lies on its side may be transposed, which would mirror it
    with pytest.raises(ImageError, match="width and height are exchanged"):
        read_observation(plain.contact.mask.T, sensor)


def test_a_camera_of_another_size_is_refused_before_anything_is_prepared(monkeypatch, tmp_path):
    """As are the first images of folders and videos; what a DIGIT delivers by default is not."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames").mkdir()
    frames = np.random.default_rng(0).integers(0, 255, (2, 480, 640, 3), np.uint8)
    write_image(tmp_path / "frames" / "1.png", frames[0])
    for name, shown in (("film.avi", frames), ("digit.avi", frames[:, :240, :320])):
        video = cv2.VideoWriter(name, cv2.VideoWriter_fourcc(*"MJPG"), 10, shown.shape[2:0:-1])
        for image in shown:
            video.write(np.ascontiguousarray(image))
        video.release()
    from geomtact.localizer import Localizer

    class Prepared(Exception):
        pass

    def prepare(*_, **__):
        raise Prepared

    monkeypatch.setattr(Localizer, "prepare", prepare)
    given = ["--object", "pin", "--sensor", "digit"]
    localize, track = ["localize", "--camera"], ["track"]
    for command, source in ((localize, "film.avi"), (track, "film.avi"), (track, "frames")):
        result = CliRunner().invoke(app, [*command, source, *given])
        assert result.exit_code == 3 and "expected 240 x 320 px for sensor digit" in " ".join(result.output.split())
    result = CliRunner().invoke(app, [*localize, "digit.avi", *given])
    assert isinstance(result.exception, Prepared)
    warning = "turning 320 x 240 px by 90 degrees counter-clockwise, as the driver of digit does"
    assert warning in " ".join(result.output.split())
    result = CliRunner().invoke(app, [*localize, "digit.avi", *given, "--rotate", "45"])
    assert result.exit_code == 2 and "expected 0, 90, 180 or 270 degrees" in " ".join(result.output.split())


BALL = 6.31e-3
BOTH = {
    "red and blue seem to be exchanged": lambda image: image[..., ::-1],
    "turned by 180 degrees": lambda image: image[::-1, ::-1],
    "mirrored left to right": lambda image: image[:, ::-1],
    "mirrored top to bottom": lambda image: image[::-1],
    "30 % darker than when": lambda image: np.rint(0.7 * image.astype(float)).astype(np.uint8),
}


@pytest.fixture(scope="module")
def calibrated_mini(data_folder):
    """A calibrated GelSight Mini, its background and the presses of another ball."""
    folder = data_folder / "gelslam_gsmini_balls"
    presses = sorted((folder / "6.310mm").glob("*.png"))[::3]
    rest = read_image(folder / "background.png")[..., :3]
    sensor = calibrate(presses, BALL, rest, sensor="gelsight-mini")
    return sensor, rest, [read_image(path)[..., :3] for path in sorted((folder / "9.500mm").glob("*.png"))[::2]]


def test_a_calibration_keeps_its_background(calibrated_mini):
    sensor, rest, _ = calibrated_mini
    again = Sensor.from_toml(sensor.to_toml())
    assert again.colour.background == sensor.colour.background and again.colour.rest.shape == (9, 12, 3)
    assert again.colour.rest.mean((0, 1)) == pytest.approx(rest.mean((0, 1)) / 255, abs=0.002)
    without = replace(sensor, colour=replace(sensor.colour, background=None))
    assert Sensor.from_toml(without.to_toml()).colour.background is None


@pytest.mark.parametrize("fault", BOTH)
def test_what_image_and_background_share_is_found_by_the_calibration(calibrated_mini, fault):
    sensor, rest, images = calibrated_mini
    for image in images:
        assert read_observation(image, sensor, background=rest).warnings == []
        both = (np.ascontiguousarray(BOTH[fault](each)) for each in (image, rest))
        (said,) = read_observation(next(both), sensor, background=next(both)).warnings
        assert fault in said


def test_heights_do_not_depend_on_the_exposure(calibrated_mini):
    sensor, rest, images = calibrated_mini
    for image in images[:4]:
        plain = contact_height(image, rest, sensor)
        dark = contact_height(*(BOTH["30 % darker than when"](each) for each in (image, rest)), sensor)
        assert dark.max() == pytest.approx(plain.max(), rel=0.05)
        assert np.corrcoef(dark.ravel(), plain.ravel())[0, 1] > 0.99


def test_a_mounted_sensor_is_calibrated_alike(calibrated_mini, data_folder):
    sensor, rest, images = calibrated_mini
    way = (90, True)
    presses = sorted((data_folder / "gelslam_gsmini_balls" / "6.310mm").glob("*.png"))[::3]
    seen = [as_camera(read_image(path)[..., :3], *way) for path in presses]
    again = calibrate(seen, BALL, as_camera(rest, *way), sensor=mounted("gelsight-mini", *way))
    assert again.colour == sensor.colour
    plain, turned_too = (
        contact_height(images[0], rest, sensor),
        contact_height(*(as_camera(e, *way) for e in (images[0], rest)), again),
    )
    assert np.array_equal(plain, turned_too)
