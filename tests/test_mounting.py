"""How a sensor is mounted, and light that flickers, are no part of what touches it."""

import cv2
import numpy as np
import pytest

from geomtact import contact_mask
from geomtact.sensing.flicker import without_flicker
from geomtact.sensing.image_file import read_image
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
    """For each set of real readings, its background and every fourth image."""

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
    """How much the contact overlaps that of each pair when both images are turned and mirrored in one way of seven."""
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


@pytest.mark.parametrize("method", METHODS)
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


@pytest.mark.parametrize("share", [0.02, 0.05, 0.1, 0.2])
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
    rng = np.random.default_rng(4)
    for name, (rest, images) in real.items():
        assert not contact_mask(striped(rest, 0.05, **random_stripes(rng)), rest).any(), name
        if name == "hsp":  # of another simulator: contacts over most of a gel that bulges
            continue
        assert all(
            without_flicker(unit(striped(image, 0.05, **random_stripes(rng))), unit(rest))[1] for image in images
        )


def test_steady_light_is_left_as_it_is(real, simulated):
    for rest, images in [*real.values(), *((rest, [image]) for image, rest in simulated)]:
        for image in images:
            evened, flicker = without_flicker(unit(image), unit(rest))
            assert flicker == 0 and np.array_equal(evened, unit(image))


@pytest.mark.parametrize("along_rows", [True, False])
def test_a_bar_all_along_the_image_is_a_contact(along_rows, rng):
    """Striped as light may be, but of the lamps' colours, and on a white gel no more than one stripe."""
    across = np.mgrid[:240, :320][0 if along_rows else 1] * PITCH - 7e-3
    depth = np.maximum(2e-3 - 1.4e-3 - (2e-3 - np.sqrt(np.maximum(4e-6 - across**2, 0))) + 0.8e-3, 0)
    image, rest = reading(cv2.GaussianBlur(depth, (0, 0), 3), rng)
    assert without_flicker(unit(image), unit(rest))[1] == 0
    white = 200 * np.ones((240, 320, 3), np.float32)
    darker = white * (1 - 100 * depth[..., None])
    assert without_flicker(darker / 255, white / 255)[1] == 0


def test_flickering_light_is_a_warning_of_the_reading(real):
    rest, images = real["gelslam"]
    image = striped(images[0], 0.05, bands=5, phase=1)
    seen = read_observation(image, "gelsight-mini", "reading", rest)
    (warning,) = seen.warnings
    assert "the light flickers" in warning and "3.5 % rms" in warning
    plain = read_observation(images[0], "gelsight-mini", "reading", rest)
    assert plain.warnings == [] and overlap(seen.contact.mask, plain.contact.mask) > 0.97
    untouched = read_observation(striped(rest, 0.05, bands=5, phase=1), "gelsight-mini", "reading", rest)
    assert not untouched.contact.mask.any()
