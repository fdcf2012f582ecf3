"""How a sensor is mounted is no part of what touches it."""

import cv2
import numpy as np
import pytest

from geomtact import contact_mask
from geomtact.sensing.image_file import read_image
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
