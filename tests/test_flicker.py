"""Stripes of flickering light are evened out, but never a contact that runs all across the image."""

import cv2
import numpy as np
import pytest
from speed import slow_but

from geomtact import contact_mask
from geomtact.sensing.flicker import without_flicker
from geomtact.sensing.local_shape import find_contact
from geomtact.sensing.reading import read_observation
from geomtact.sensing.render import Lamps, render

SHAPE, PITCH = (240, 320), 6e-5
WHITE = 0.7 * np.array([1, 0.97, 0.9])
SIZES = {"rod": (0.3, 0.53, 0.7, 0.8), "bar": (0.3, 0.5, 0.7, 0.8), "ribs": (2, 3, 4, 5)}
KINDS = [(kind, size) for kind, sizes in SIZES.items() for size in sizes]
LIGHTS = ("depth", "side", "slope", "around", "three sides", "three sides, mixed")


def pressed(kind, size, tilt, along_rows):
    """How deep (H, W) [m] a gel is pressed in by a rod of 10 mm radius or a bar over a share of the rows, or by ribs [mm]; and
    where (H, W) it is touched."""
    y, x = (np.mgrid[: SHAPE[0], : SHAPE[1]] - 0.5 * np.array(SHAPE)[:, None, None]) * PITCH
    across, along = (y, x) if along_rows else (x, y)
    u = across * np.cos(np.radians(tilt)) + along * np.sin(np.radians(tilt))
    half = size * SHAPE[0 if along_rows else 1] * PITCH / 2
    if kind == "rod":
        depth = np.sqrt(np.maximum(1e-4 - u**2, 0)) - np.sqrt(1e-4 - half**2)
    elif kind == "bar":
        depth = np.where(abs(u) < half, 6e-4, 0)
    else:
        depth = 3e-4 * np.cos(2 * np.pi * u / (1e-3 * size))
    depth = np.maximum(depth, 0)
    return cv2.GaussianBlur(np.maximum(depth, cv2.GaussianBlur(depth, (0, 0), 6)), (0, 0), 2), depth > 0


def reading(depth, light, rng):
    """An image and its background (H, W, 3), 0..1, of a gel in white or coloured light.

    In white light it gets darker where it is pressed in ("depth"), faces away from a lamp ("side") or is steep ("slope").
    Coloured lamps are all around, on three sides, or there with half of each one's light in the others' channels ("mixed").
    """
    x, y = np.meshgrid(np.linspace(-1, 1, SHAPE[1]), np.linspace(-1, 1, SHAPE[0]))
    rest = 0.45 * (1 - 0.2 * (x**2 + y**2))[..., None]
    response, shading = np.zeros((3, 2, 3)), np.zeros(3)
    if light in ("depth", "side", "slope"):
        rest = rest / 0.45 * WHITE
        response[..., 0] = 0.6 * (light == "side")
        shading += 2.0 * (light == "slope")
    elif light == "around":
        response = Lamps.around().response
    else:
        share = 0.55 if "mixed" in light else 0.2
        response[..., 0] = 0.6 * (share + (1 - share) * np.eye(3)) @ [[-1, 0], [0, 1], [1, 0]]
    if light in ("around", "three sides", "three sides, mixed"):
        rest = rest * (1 + 0.4 * np.einsum("hwk,ck->hwc", np.stack([x, y], -1), -Lamps.around().response[..., 0]))
    image = render(depth, (PITCH, PITCH), rest, Lamps(response, shading, 1.0))
    if light == "depth":
        image = image * (1 - 400 * depth[..., None])
    both = (each + rng.normal(size=rest.shape) / 255 for each in (image, rest))
    return tuple((np.rint(255 * np.clip(each, 0, 1)) / 255).astype(np.float32) for each in both)


def striped(image, share, bands=5.0):
    gain = 1 + share * np.sin(2 * np.pi * bands * np.arange(len(image)) / len(image) + 1)
    return (np.rint(np.clip(255 * image * gain[:, None, None], 0, 255)) / 255).astype(np.float32)


def overlap(a, b):
    return (a & b).sum() / max((a | b).sum(), 1)


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("along_rows", slow_but([True, False], True))
def test_no_contact_all_across_the_image_is_evened_out(light, along_rows, rng):
    """Rods, bars and ribs, tilted by up to a degree: the image stays as it is, so the contact does."""
    for kind, size in KINDS:
        for tilt in (0, 0.5, 1):
            depth, _ = pressed(kind, size, tilt, along_rows)
            image, rest = reading(depth, light, rng)
            assert np.array_equal(without_flicker(image, rest).image, image), (kind, size, tilt)


@pytest.mark.parametrize("light", ["depth", "side", "three sides"])
@pytest.mark.parametrize(("kind", "size"), [("rod", 0.53), ("ribs", 3)])
def test_a_contact_all_across_the_image_is_found(kind, size, light, rng):
    depth, touched = pressed(kind, size, 0.5, True)
    image, rest = reading(depth, light, rng)
    found = contact_mask(image, rest)
    assert np.array_equal(found, find_contact(image, rest).mask) and overlap(found, touched) > 0.5


def test_a_possible_contact_is_a_warning(rng):
    depth, _ = pressed("ribs", 3, 0, True)
    image, rest = reading(depth, "depth", rng)
    seen = read_observation(image, "gelsight-mini", "reading", rest)
    (warning,) = (each for each in seen.warnings if "stripes" in each)
    assert "not evened out, for in white light a contact looks alike" in warning and "\n" not in warning
    assert np.array_equal(seen.contact.mask, contact_mask(image, rest, "gelsight-mini"))
    image, rest = reading(depth, "three sides, mixed", rng)
    assert "stronger in one colour" in without_flicker(image, rest).unsure


@pytest.mark.parametrize("light", LIGHTS)
def test_stripes_on_an_untouched_gel_are_evened_out_in_coloured_light_and_warned_of_in_white(light, rng):
    image, rest = reading(np.zeros(SHAPE), light, rng)
    for share in (0.05, 0.1, 0.2):
        for bands in (2.3, 5, 17):
            seen = read_observation(striped(image, share, bands), "gelsight-mini", "reading", rest)
            (warning,) = (each for each in seen.warnings if "stripes" in each)
            white = light in ("depth", "side", "slope")
            assert ("not evened out" in warning) == white and (white or not seen.contact.mask.any())


def test_stripes_of_more_than_lamps_flicker_are_left(rng):
    image, rest = reading(np.zeros(SHAPE), "around", rng)
    light = without_flicker(striped(image, 0.3), rest)
    assert "hardly flicker" in light.unsure and light.stripes > 0.15


def test_without_a_background_stripes_are_warned_of(rng):
    image, _ = reading(np.zeros(SHAPE), "around", rng)
    for each, wanted in ((image, 0), (striped(image, 0.05), 1)):
        seen = read_observation(each, "gelsight-mini", "reading")
        assert sum("not evened out, for no background was given" in said for said in seen.warnings) == wanted
