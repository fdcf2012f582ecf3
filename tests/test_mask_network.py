"""The network that finds contacts: its training images, a repeatable run, and its agreement with imprints drawn by hand."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from typer.testing import CliRunner

from geomtact import InputError, UsageError, contact_mask
from geomtact.geometry.mesh import Mesh
from geomtact.sensing import mask_network
from geomtact.sensing.image_file import read_image
from geomtact.sensing.local_shape import find_contact
from geomtact.sensing.mask_network import CHANNELS, WEIGHTS, MaskNetwork, contact_probability, seen, smoothed
from geomtact.sensing.reading import read_observation
from geomtact.sensing.sensor import Sensor
from geomtact.training.state import read_weights
from tools.studies.__main__ import app as studies
from tools.studies.readings.study import (
    Imprint,
    find,
    imprints,
    largest_difference,
    methods,
    off_centre,
    overlap,
    summarise_contacts,
)
from tools.training import presses
from tools.training.contact import Settings, train_mask, validate, write_mask_network
from tools.training.presses import PRESSES, READINGS, make_presses, press_part


def disk(x, y, r, shape=(120, 160)):
    v, u = np.indices(shape)
    return np.hypot(u - x, v - y) <= r


@pytest.fixture(scope="module")
def parts():
    return [press_part(i, 7) for i in range(3)]


@pytest.mark.slow
def test_a_press_shows_colour_around_its_contact(parts):
    again = press_part(0, 7)
    assert np.array_equal(again.seen, parts[0].seen) and np.array_equal(again.contact, parts[0].contact)
    for part in parts:
        assert part.seen.shape == (PRESSES, READINGS, CHANNELS, 60, 80) and part.contact.shape == (PRESSES, 60, 80)
        assert part.contact.min() >= 0 and part.contact.max() <= 1 and (part.contact.max((1, 2)) > 0.5).all()
        # the gel is flat under a flat face: colours show at the contact's border
        touched = (part.contact > 0.5).astype(np.uint8)
        rim, far = (np.stack([cv2.dilate(each, np.ones((n, n))) for each in touched]) > 0 for n in (5, 25))
        rim &= ~np.stack([cv2.erode(each, np.ones((5, 5))) for each in touched]).astype(bool)
        size = np.linalg.norm(part.seen[:, :, :3].astype(float), axis=2)
        more = [size[:, i][rim].mean() / size[:, i][~far].mean() for i in range(READINGS)]
        assert np.median(more) > 2 and min(more) > 1.5, more


def test_a_gel_that_bulges_is_touched_by_a_plate_as_hertz_has_it(monkeypatch):
    """A disk in the middle, of radius sqrt(R d)."""
    plate = trimesh.creation.box((0.2, 0.2, 0.01))
    monkeypatch.setattr(presses, "_part", lambda *_: Mesh(plate.vertices, plate.faces, "plate", "m"))
    fixed = {"FLAT": 1.0, "TILT": 0.0, "CURVED": 1.0, "BULGES": (0.03, 0.03), "DEPTHS": (1e-3, 1e-3)}
    for name, value in (fixed | {"THICKNESS": (10.0, 10.0), "PRESSES": 2}).items():
        monkeypatch.setattr(presses, name, value)
    for contact in press_part(1, 7).contact.astype(float):
        pixel = presses.PITCH * presses.SHAPE[0] / len(contact)
        assert contact.sum() * pixel**2 == pytest.approx(np.pi * 0.03 * 1e-3, rel=0.03)
        middle = np.average(np.indices(contact.shape).reshape(2, -1), axis=1, weights=contact.ravel())
        assert middle == pytest.approx((np.array(contact.shape) - 1) / 2, abs=0.3)


@pytest.mark.slow
def test_presses_are_made_once(tmp_path, monkeypatch):
    monkeypatch.setattr(presses, "PRESSES", 2)
    first = make_presses(tmp_path, 1, 7, processes=1)
    made = (tmp_path / "0.npz").stat().st_mtime_ns
    second = make_presses(tmp_path, 1, 7, processes=1)
    assert np.array_equal(first[0].seen, second[0].seen) and (tmp_path / "0.npz").stat().st_mtime_ns == made


@pytest.mark.slow
def test_a_stopped_run_goes_on_to_the_same_weights(parts, tmp_path):
    settings = Settings(steps=6, batch=4, validation=1)
    whole, curve = train_mask(parts, settings, tmp_path / "whole", check_every=3)

    class StopError(Exception):
        pass

    def stop(share, _):
        if share > 0.6:
            raise StopError

    with pytest.raises(StopError):
        train_mask(parts, settings, tmp_path / "stopped", stop, check_every=3)
    resumed, same = train_mask(parts, settings, tmp_path / "stopped", check_every=3)
    assert same == curve and curve["step"] == [3, 6]
    for a, b in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(InputError, match="expected more than 3 parts, got 3"):
        train_mask(parts, replace(settings, validation=3), tmp_path / "few")


@pytest.mark.slow
def test_a_step_of_training_lowers_the_loss(parts, tmp_path):
    _, curve = train_mask(parts, Settings(steps=30, batch=8, validation=1), tmp_path, check_every=10)
    assert curve["training"][-1] < 0.8 * curve["training"][0]


@pytest.mark.slow
def test_training_goes_on_from_weights_that_are_given(parts, tmp_path):
    first, _ = train_mask(parts, Settings(steps=10, batch=8, validation=1), tmp_path / "first")
    write_mask_network(tmp_path / "first.safetensors", first, {}, Settings(), 0)
    weights = read_weights(tmp_path / "first.safetensors")
    still = Settings(steps=1, rate=0.0, batch=8, validation=1)
    same, _ = train_mask(parts, still, tmp_path / "still", start=weights)
    for name, value in same.state_dict().items():
        assert torch.equal(value, weights[name])
    # those of a network that is less deep, or sees less, start with the same output
    shallow = {name: value for name, value in weights.items() if not name.startswith("deeper.")}
    shallow["down.0.0.weight"] = shallow["down.0.0.weight"][:, :6]
    x = torch.randn(2, CHANNELS, 24, 32, generator=torch.Generator().manual_seed(1))
    grown = [train_mask(parts, still, tmp_path / name, start=shallow)[0] for name in ("grown", "again")]
    with torch.inference_mode():
        seen_whole, blind = grown[0](x), grown[1](x * (torch.arange(CHANNELS) < 6)[:, None, None])
        assert torch.equal(seen_whole, blind)
        less = first.eval()
        for block in less.deeper.parameters():
            block.zero_()
        assert torch.allclose(less(x * (torch.arange(CHANNELS) < 6)[:, None, None]), seen_whole, atol=2e-2)
    with pytest.raises(InputError, match="--start: the weights of another network"):
        train_mask(parts, still, tmp_path / "other", start={"a": torch.zeros(1)})
    with pytest.raises(InputError, match="not a whole safetensors file"):
        read_weights(tmp_path / "none.safetensors")


def test_a_written_file_records_its_inputs(tmp_path):
    network = MaskNetwork().eval()
    path = tmp_path / "mask.safetensors"
    write_mask_network(path, network, {"step": []}, Settings(), 12)
    card = path.with_suffix(".json").read_text("utf-8")
    assert '"schema": "geomtact/mask-network/1"' in card and '"presses": 12' in card and '"kornia"' in card
    assert path.stat().st_size < 5e6


@pytest.mark.slow
def test_the_bundled_network_segments_unseen_presses():
    """Its validation objects have other seeds; on simulated images it is right about most of the contact."""
    from geomtact.sensing.mask_network import _network

    parts = [press_part(i, 991) for i in range(4)]
    sights, contact = (torch.from_numpy(np.concatenate([getattr(p, n) for p in parts])) for n in ("seen", "contact"))
    assert WEIGHTS.stat().st_size < 5e6
    assert validate(_network(), sights, contact) > 0.75


def test_noise_from_pixel_to_pixel_is_smoothed(monkeypatch, rng):
    """A shape is left as it is but for a share of a pixel; single pixels beside it or in it are not."""
    rows, columns = np.mgrid[:60, :80]
    shape = 4.0 * np.clip(15 - np.hypot(rows - 30, columns - 40), -1, 1).astype(np.float32)
    odd = rng.permutation(shape.size)[:40]
    trembling = shape.copy()
    trembling.flat[odd] *= -0.9
    inside = shape > 0
    assert ((trembling > 0) != inside).sum() > 35
    assert ((smoothed(trembling) > 0) != inside).sum() < 8 and ((smoothed(shape) > 0) != inside).sum() < 8
    # and this is what the probability is made of
    looks = torch.from_numpy(np.stack([trembling[::i, ::j] for i, j in ((1, 1), (1, -1), (-1, -1), (-1, 1))]))
    monkeypatch.setattr(mask_network, "_network", lambda: lambda x: looks)
    change = rng.normal(0, 0.01, (60, 80, 3))
    expected = 1 / (1 + np.exp(-smoothed(trembling)))
    assert contact_probability(change, np.full((60, 80, 3), 0.4)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("shape", [(120, 160), (160, 120), (96, 96)])
def test_a_gel_is_seen_alike_however_the_camera_is_mounted(shape, rng):
    change, image = (
        cv2.resize(rng.uniform(*ends, (12, 16, 3)), shape[::-1], interpolation=cv2.INTER_CUBIC)
        for ends in ((-0.3, 0.3), (0.2, 1.1))
    )
    probability = contact_probability(change, image)
    assert np.ptp(probability) > 0.2
    for turns in range(4):
        for step in (1, -1):
            turned = (np.rot90(each[:, ::step], turns) for each in (change, image, probability))
            changed, seen_so, expected = turned
            assert contact_probability(changed, seen_so) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("shape", [(240, 320), (320, 240), (123, 161)])
def test_images_of_any_shape_get_a_probability_at_each_pixel(shape, rng):
    change, image = rng.normal(0, 0.01, (*shape, 3)), rng.uniform(0.3, 0.6, (*shape, 3))
    probability = contact_probability(change, image)
    assert probability.shape == shape and (probability >= 0).all() and (probability <= 1).all()
    # in shares of the strongest: how much the same gel changes under the same light means nothing
    assert contact_probability(7 * change, image + 6 * change) == pytest.approx(probability, abs=1e-4)
    assert min(seen(change, image).shape[1:]) == 60 and len(seen(change, image)) == CHANNELS


def test_the_sensor_chooses_the_contact_method_and_probabilities_reach_the_localizer(data_folder):
    folder = data_folder / "gelslam_gsmini_balls"
    image, background = (read_image(folder / name) for name in ("6.310mm/40.png", "background.png"))
    plain = Sensor.load("gelsight-mini")
    learned = replace(plain, contact_method="learned")
    assert Sensor.from_toml(learned.to_toml()).contact_method == "learned"
    first, second = (read_observation(image, each, background=background).contact for each in (plain, learned))
    assert first.probability is None and np.array_equal(first.mask, contact_mask(image, background, plain))
    assert np.array_equal(second.mask, contact_mask(image, background, plain, "learned"))
    assert np.array_equal(second.mask, second.probability > 0.5) and second.soft_mask is second.probability


@pytest.mark.slow
def test_by_default_the_network_segments_where_light_saturates_and_colours_show_slopes(data_folder):
    """On the gels of FOTS and ObjectFolder one channel is blown out beside every ball, on the GelSight Mini none ever is."""
    for name, some in imprints(data_folder).items():
        for number, drawn in enumerate(some):
            found = find_contact(drawn.image, drawn.background)
            assert found.method == "learned", (name, drawn.name)
            if number % 8:
                continue
            learned = find_contact(drawn.image, drawn.background, None, "learned")
            assert np.array_equal(found.mask, learned.mask) and np.array_equal(found.probability, learned.probability)
            darker = [np.float32(0.97 / 255) * each for each in (drawn.image, drawn.background)]
            assert find_contact(*darker).method == "learned", "a camera whose white is a little less than white"
    presses = data_folder / "gelslam_gsmini_balls"
    background = read_image(presses / "background.png")
    for number, path in enumerate(sorted(presses.glob("*mm/*.png"))):
        image = read_image(path)
        found = find_contact(image, background)
        assert found.method == "classical" and found.probability is None
        if number % 8:
            continue
        assert np.array_equal(found.mask, contact_mask(image, background, method="classical"))
        lit, rest = (np.clip(2 * each.astype(int), 0, 255).astype(np.uint8) for each in (image, background))
        for pair in ((lit, rest), (lit, None), (lit, background), (image, rest)):
            assert find_contact(*pair).method == "learned", "under twice the light, before, after or both"
        assert find_contact(*(np.repeat(each[..., 1:2], 3, -1) for each in (lit, rest))).method == "classical"


def test_the_contact_method_is_recorded(data_folder):
    drawn = imprints(data_folder)["fots"][0]
    height, width = drawn.image.shape[:2]
    plain = replace(Sensor.load("gelsight-mini"), image_size_px=(width, height))
    for method, expected in (("auto", "learned"), ("pressure", "pressure")):
        seen = read_observation(
            drawn.image, replace(plain, contact_method=method), "reading", background=drawn.background
        )
        assert seen.method == expected
    assert read_observation(np.zeros((height, width), bool), plain).method is None


def test_an_unknown_method_is_refused(rng):
    image = rng.uniform(0, 1, (120, 160, 3))
    with pytest.raises(UsageError, match="no method named 'classicl'.*classical"):
        contact_mask(image, image, method="classicl")


def test_overlap_and_centre_are_those_of_the_circle_made_smaller(rng):
    some, factors = rng.random((120, 160)) < 0.4, np.arange(0.5, 2, 0.02)
    v, u = np.indices(some.shape)
    disks = [np.hypot(u - 75.3, v - 61.8) <= 36 / factor for factor in factors]
    plain = [(some & each).sum() / (some | each).sum() for each in disks]
    assert np.array_equal(overlap(some, (75.3, 61.8, 36), factors), plain)
    mask = disk(80, 60, 20)
    assert overlap(mask, (80, 60, 20), 1.0) == 1
    assert overlap(mask, (80, 60, 26), 1.3) == 1
    assert overlap(mask, (80, 60, 40), 1.0) == pytest.approx(0.25, abs=0.01)
    assert off_centre(mask, (80, 60, 20)) == pytest.approx(0, abs=1e-9)
    assert off_centre(mask, (88, 66, 20)) == pytest.approx(10 / 160)
    assert off_centre(np.zeros((120, 160), bool), (80, 60, 20)) == np.inf


def test_the_factor_of_one_half_is_evaluated_on_the_other():
    """Contacts of even images fill 1 / 1.3 of the imprint, of odd ones 1 / 1.5: each is scored with the other's factor."""
    image = np.zeros((120, 160, 3), np.uint8)
    drawn = [Imprint(f"{i}", np.full_like(image, i), image, (80.0, 60.0, 36.0)) for i in range(8)]
    found = find(drawn, "made", lambda image, _: disk(80, 60, 36 / (1.5 if image[0, 0, 0] % 2 else 1.3)))
    assert [f.factor for f in found[:2]] == pytest.approx([1.5, 1.3], abs=0.021)
    figures = summarise_contacts(found)
    assert figures["n"] == 8 and figures["iou_median"] == pytest.approx((1.3 / 1.5) ** 2, abs=0.04)
    assert figures["iou_interval"][0] <= figures["iou_median"] <= figures["iou_interval"][1]


def test_the_baseline_takes_the_largest_changed_region(rng):
    background = rng.integers(100, 110, (120, 160, 3)).astype(np.uint8)
    image = background.copy()
    image[disk(50, 50, 15)] += 60
    image[disk(130, 90, 5)] += 60
    assert overlap(largest_difference(image, background), (50, 50, 15), 1.0) > 0.97


def test_real_imprints_are_read_and_ours_is_nearer_than_the_baseline(data_folder):
    sets = imprints(data_folder)
    assert {name: len(some) for name, some in sets.items()} == {"fots": 28, "objectfolder": 32}
    assert set(methods()) == {"auto", "classical", "pressure", "learned", "difference"}
    some = sets["objectfolder"][::4]
    *both, baseline = (find(some, name, methods()[name]) for name in ("auto", "classical", "difference"))
    for ours in both:
        assert np.median([f.iou for f in ours]) > np.median([f.iou for f in baseline])
        assert max(f.centre for f in ours) < 0.03


def test_a_folder_without_tactile_images_is_refused(tmp_path):
    run = CliRunner().invoke(studies, ["readings", str(tmp_path)])
    assert run.exit_code == 3 and "expected fots_balls and objectfolder_gelsight_calib in it" in run.output
