"""Laws of loading an image: its kind, the errors of bad files, and the contact in real RGB tactile images."""

import csv
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from geomtact.errors import ImageError, UsageError
from geomtact.sensing.image_file import ImageFile, read_image, write_image
from geomtact.sensing.local_shape import contact_mask
from geomtact.sensing.pixels import median_of
from geomtact.sensing.reading import read_observation
from geomtact.sensing.sensor import Sensor
from tools.studies.readings.study import find, imprints

MINI = Sensor.load("gelsight-mini")
SHAPE = (240, 320)


def disk(x: float, y: float, r: float, shape=SHAPE) -> np.ndarray:
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return (columns - x) ** 2 + (rows - y) ** 2 <= r**2


MASK = disk(200, 90, 40)
HEIGHT = np.where(MASK, 3.2e-4, 0).astype(np.float32) + np.where(disk(200, 90, 20), 2e-4, 0).astype(np.float32)


def write(path: Path, array: np.ndarray) -> Path:
    """Any array as a file of the path's type, with OpenCV (BGR), tifffile or numpy."""
    if path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".tif":
        import tifffile

        tifffile.imwrite(path, array)
    else:
        if array.ndim == 3:
            array = array[..., [2, 1, 0, *range(3, array.shape[2])]]
        assert cv2.imwrite(str(path), array)
    return path


@pytest.fixture
def background(rng) -> np.ndarray:
    y, x = np.mgrid[0:1:240j, 0:1:320j]
    light = np.stack([60 + 90 * x, 70 + 60 * y, 120 - 50 * x * y], -1)
    return np.clip(light + rng.normal(0, 2, light.shape), 0, 255).astype(np.uint8)


def press(background: np.ndarray, x: float, y: float, r: float, rng, gain: float = 40.0) -> np.ndarray:
    """A spherical dent lit by three coloured lights from three sides."""
    rows, columns = np.mgrid[: background.shape[0], : background.shape[1]]
    slope = np.stack([columns - x, rows - y], -1) / r * disk(x, y, r, background.shape[:2])[..., None]
    turn = np.radians([90, 210, 330])
    change = gain * slope @ np.stack([np.cos(turn), np.sin(turn)])
    return np.clip(background + change + rng.normal(0, 2, background.shape), 0, 255).astype(np.uint8)


# ---------------------------------------------------------------- kinds


@pytest.mark.parametrize(
    "array",
    [
        pytest.param(MASK, id="bool"),
        pytest.param(MASK * np.uint8(255), id="0/255"),
        pytest.param(MASK.astype(int), id="int 0/1"),
        pytest.param(MASK.astype(float), id="float 0/1"),
        pytest.param(MASK * np.uint16(7), id="uint16 0/7"),
        pytest.param(np.repeat((MASK * np.uint8(9))[..., None], 3, 2), id="three equal channels"),
    ],
)
def test_two_valued_images_are_masks(array):
    seen = read_observation(array, MINI)
    assert seen.kind == "mask" and seen.warnings == [] and seen.contact.height is None
    assert seen.contact.mask.dtype == bool and np.array_equal(seen.contact.mask, MASK)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".npy"])
def test_a_mask_is_the_same_from_every_file(tmp_path, suffix):
    path = write(tmp_path / f"mask{suffix}", MASK * np.uint8(255))
    for source in (path, str(path)):
        assert np.array_equal(read_observation(source, "gelsight-mini").contact.mask, MASK)


@pytest.mark.parametrize("suffix", [".npy", ".tif"])
def test_float_images_are_heights_in_metres(tmp_path, suffix):
    seen = read_observation(write(tmp_path / f"height{suffix}", HEIGHT), MINI)
    assert seen.kind == "height" and seen.warnings == []
    assert np.array_equal(seen.contact.height, HEIGHT) and np.array_equal(seen.contact.mask, MASK)


def test_a_faint_pixel_beside_a_rigid_contact_is_no_fading():
    height = HEIGHT.copy()
    height[5, 5] = 5e-6
    assert read_observation(height, MINI).warnings == []


@pytest.mark.parametrize("n", [1, 2, 7, 1000])
def test_the_median_is_numpys(n, rng):
    values = rng.integers(0, 5, n) + np.round(rng.normal(size=n), 1)
    for dtype in (np.float32, np.float64):
        assert median_of(values.astype(dtype)) == np.median(values.astype(dtype))


def test_noise_all_over_a_soft_gel_is_no_contact(rng):
    """A ball under which the gel is half as deep at the contact's border, and 0.1 mm of noise wherever it is pressed in."""
    rows, columns = np.mgrid[:240, :320]
    far = np.hypot(columns - 200, rows - 90) / 40
    ball = np.where(far < 1, 1 - far**2 / 2, np.exp(-(far - 1)) / 2) * 1e-3
    noise = cv2.GaussianBlur(rng.normal(size=ball.shape), (0, 0), 8)
    height = np.maximum(ball + 1e-4 * noise / noise.std(), 0).astype(np.float32)
    found, touched = read_observation(height, MINI).contact.mask, disk(200, 90, 40)
    assert (found & touched).sum() > 0.95 * found.sum() and (found & touched).sum() > 0.4 * touched.sum()


def test_a_colourless_float_image_of_three_channels_is_a_reading(background):
    grey = np.repeat(background[..., :1] / 255, 3, -1)
    seen = read_observation(grey, MINI)
    assert seen.kind == "reading" and not seen.contact.mask.any()


def test_a_grey_image_does_not_go_with_a_background_in_colour(background):
    with pytest.raises(ImageError, match="one of image and background has colours, the other is grey"):
        read_observation(background[..., 0], MINI, "reading", background)


def test_whole_numbers_of_a_reading_are_0_to_255(background):
    wide = background.astype(np.int32)
    same = [read_observation(image, MINI, background=background).contact.mask for image in (background, wide)]
    assert np.array_equal(*same)
    wide[3, 4, 1] = 1000
    with pytest.raises(
        ImageError, match=r"a tactile image of int32 must lie in 0\.\.255, got \d+ to 1000; give uint8 or uint16"
    ):
        read_observation(wide, MINI, background=background)


def test_sixteen_bit_grey_is_height_in_micrometres(tmp_path):
    seen = read_observation(write(tmp_path / "height.png", np.round(HEIGHT * 1e6).astype(np.uint16)), MINI)
    assert seen.kind == "height"
    assert np.abs(seen.contact.height - HEIGHT).max() < 0.51e-6


def test_heights_of_less_than_a_micrometre_have_a_wrong_unit():
    with pytest.raises(ImageError, match=r"expected depths in metres .* divided by 1000 once too often"):
        read_observation(HEIGHT * 1e-4, MINI)


def test_the_order_of_bytes_does_not_matter():
    micrometres = np.round(HEIGHT * 1e6).astype(np.uint16)
    for array in (micrometres, HEIGHT):
        seen, swapped = (read_observation(array.astype(array.dtype.newbyteorder(order)), MINI) for order in "<>")
        assert seen.kind == swapped.kind and np.array_equal(seen.contact.height, swapped.contact.height)


def test_three_channels_are_a_reading_in_rgb_order(tmp_path, background, rng):
    image = press(background, 120, 100, 40, rng)
    path = write(tmp_path / "reading.png", image)
    assert np.array_equal(read_image(path), image), "a file's colours come in RGB order"
    masks = [read_observation(source, MINI, background=background) for source in (path, image, image / 255.0)]
    assert [m.kind for m in masks] == ["reading"] * 3 and masks[0].warnings == []
    assert masks[0].contact.mask.any()
    assert np.array_equal(masks[0].contact.mask, masks[1].contact.mask)
    assert np.array_equal(masks[0].contact.mask, masks[2].contact.mask)
    without = read_observation(path, MINI)
    assert ["no background was given" in w for w in without.warnings] == [True]


def test_other_grey_is_a_reading_with_a_warning(background, rng):
    grey = press(background, 120, 100, 40, rng)[..., 1]
    seen = read_observation(grey, MINI, background=background[..., 1])
    assert seen.kind == "reading" and "grey image with many values is read as a tactile image" in seen.warnings[0]
    assert np.hypot(*(np.argwhere(seen.contact.mask).mean(0) - [100, 120])) < 20


@pytest.mark.parametrize("quality", [50, 95])
def test_a_mask_kept_as_jpeg_is_suspected_and_read_back(tmp_path, quality, background):
    """Compression leaves a rim of small numbers, which must not count as contact."""
    path = tmp_path / "mask.jpg"
    assert cv2.imwrite(str(path), MASK * np.uint8(255), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert (read_image(path) > 0).sum() > 1.05 * MASK.sum()
    seen = read_observation(path, MINI)
    assert seen.kind == "reading" and "for a mask give --kind mask (and PNG" in seen.warnings[0]
    seen = read_observation(path, MINI, kind="mask")
    assert np.array_equal(seen.contact.mask, MASK) and "what is over half counts as contact" in seen.warnings[0]
    seen = read_observation(write(tmp_path / "reading.jpg", background[..., 1]), MINI)
    assert "grey image with many values" in seen.warnings[0]


def test_a_kind_that_is_given_wins():
    levels = np.where(MASK, 100, 0).astype(np.uint8) + disk(200, 90, 10).astype(np.uint8)
    seen = read_observation(levels, MINI, kind="mask")
    assert np.array_equal(seen.contact.mask, MASK) and "more than two values" in seen.warnings[0]
    assert np.array_equal(read_observation(HEIGHT, MINI, kind="mask").contact.mask, MASK)
    flat = np.where(MASK, np.float32(1e-3), 0)
    assert np.array_equal(read_observation(flat, MINI, kind="height").contact.height, flat)
    with pytest.raises(UsageError, match="unknown kind 'hight'; did you mean 'height'"):
        read_observation(HEIGHT, MINI, kind="hight")


def test_opaque_alpha_is_dropped_with_a_note(tmp_path, background):
    opaque = np.concatenate([background, np.full((*SHAPE, 1), 255, np.uint8)], -1)
    seen = read_observation(write(tmp_path / "rgba.png", opaque), MINI, background=background)
    assert seen.warnings[0].endswith("the opaque alpha channel was dropped")
    assert np.array_equal(seen.image, background) and not seen.contact.mask.any()
    opaque[5, 5, 3] = 0
    with pytest.raises(ImageError, match="transparent pixels; flatten it"):
        read_observation(opaque, MINI)


def test_sixteen_bit_colour_is_a_reading_like_its_eight_bit_self(tmp_path, background, rng):
    image = press(background, 120, 100, 40, rng)
    deep = write(tmp_path / "deep.png", image.astype(np.uint16) * 257)
    mask = read_observation(deep, MINI, background=background).contact.mask
    assert np.array_equal(mask, contact_mask(image, background))


def test_no_contact_is_a_result_and_all_contact_a_warning():
    for array in (np.zeros(SHAPE, bool), np.zeros(SHAPE, np.uint8), np.zeros(SHAPE, np.float32)):
        seen = read_observation(array, MINI)
        assert not seen.contact.mask.any() and seen.warnings == []
    for array in (np.ones(SHAPE, bool), np.full(SHAPE, 255, np.uint8), np.full(SHAPE, 3e-4)):
        seen = read_observation(array, MINI)
        assert seen.contact.mask.all() and "so its outline is not seen" in seen.warnings[0]


def test_a_background_for_a_mask_is_a_warning(background):
    assert (
        "image: the background is not used: a mask needs none"
        in read_observation(MASK, MINI, background=background).warnings[0]
    )


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (MASK.T, "(width x height), got 240 x 320 px; width and height are exchanged: say how the camera is mounted"),
        (MASK[:, :300], "expected 320 x 240 px for sensor gelsight-mini (width x height), got 300 x 240 px; name the sen"),
        (MASK[::2, ::2], "got 160 x 120 px; the shape agrees: scale a mask to that"),
        (np.zeros((0, 320)), "expected (H, W) or (H, W, 3), got an array of shape (0, 320)"),
        (np.zeros(320), "got an array of shape (320,)"),
        (np.zeros((*SHAPE, 7)), "got an array of shape (240, 320, 7)"),
        (np.zeros((2, *SHAPE, 3)), "got an array of shape (2, 240, 320, 3); give one image"),
        (np.array([["a"]]), "expected numbers, got an array of <U1"),
        (np.where(MASK, np.nan, 0), "values are NaN or infinite"),
        (np.where(MASK, np.inf, 0), "values are NaN or infinite"),
        (HEIGHT - 2e-4, "depths of the gel's indentation are >= 0; the lowest is -0.0002 m"),
        (HEIGHT * 1e3, "expected depths in metres up to about 0.002, the largest is 0.52"),
        (np.dstack([*np.mgrid[:240, :320], MASK]) / 1.0, "a float tactile image must lie in 0..1, got 0 to 319; divide by"),
    ],
)  # fmt: skip
def test_arrays_that_make_no_sense_are_refused(array, message):
    with pytest.raises(ImageError, match=re.escape(message)):
        read_observation(array, MINI)


@pytest.mark.parametrize("kind", ["mask", "height"])
def test_a_colour_image_is_no_mask_and_no_height(background, kind):
    with pytest.raises(ImageError, match="has one channel, got a colour image"):
        read_observation(background, MINI, kind=kind)


def test_eight_bit_heights_have_no_unit():
    with pytest.raises(ImageError, match=r"float \(metres\) or 16-bit \(micrometres\), got uint8"):
        read_observation(np.arange(240 * 320, dtype=np.uint8).reshape(SHAPE), MINI, kind="height")


def test_a_background_of_another_size_is_refused(background, tmp_path):
    with pytest.raises(
        ImageError, match="background: expected 320 x 240 px .* width and height are exchanged: .*--rotate 90 turns"
    ):
        read_observation(background, MINI, background=background.swapaxes(0, 1))
    path = write(tmp_path / "untouched.png", background[:200])
    with pytest.raises(ImageError, match=re.escape(f"background {path}: expected 320 x 240 px")):
        read_observation(background, MINI, background=path)
    with pytest.raises(ImageError, match="background: expected the size of the image, 320 x 240 px, got 320 x 200 px"):
        contact_mask(background, background[:200])
    with pytest.raises(
        ImageError, match="expected 240 x 320 px for sensor digit-hsp .*, got 320 x 240 px; width and height"
    ):
        contact_mask(background, background, "digit-hsp")
    with pytest.raises(ImageError, match=r"image: expected an RGB image \(H, W, 3\)"):
        contact_mask(background[..., 0])
    with pytest.raises(ImageError, match=r"image: expected an RGB image \(H, W, 3\) or its path, got none; give it"):
        contact_mask(None, background)


def test_a_grey_file_is_named_with_its_own_shape(tmp_path):
    write_image(tmp_path / "grey.png", np.ones((24, 32), bool))
    with pytest.raises(
        ImageError, match=r"grey.png: expected an RGB image.* of shape \(24, 32\); give one image, in colour"
    ):
        contact_mask(tmp_path / "grey.png")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.png", b"", "the file is empty (0 bytes)"),
        ("text.png", b"this is no image", "not an image; give a PNG"),
        ("text.npy", b"\x93NUMPY", "not a whole .npy array"),
        ("tail.tif", b"II*\0\x08\0\0\0", "the TIFF file is damaged"),
    ],
)
def test_files_that_are_no_images_are_named(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ImageError, match=re.escape(f"{path}: {message}")):
        read_observation(path, MINI)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".npy"])
@pytest.mark.parametrize("share", [0.2, 0.7, 0.98])
def test_truncated_files_are_refused(tmp_path, background, suffix, share):
    path = write(tmp_path / f"reading{suffix}", background)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ImageError, match=re.escape(str(path))):
        read_observation(path, MINI)


def test_a_damaged_png_is_refused(tmp_path, background):
    path = write(tmp_path / "reading.png", background)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(ImageError, match="truncated or damaged"):
        read_observation(path, MINI)


def test_missing_files_folders_pickles_and_stacks_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ImageError, match="no such file"):
        read_observation(tmp_path / "nothing.png", MINI)
    with pytest.raises(ImageError, match="got a folder"):
        read_observation(tmp_path, MINI)
    np.save(tmp_path / "object.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(ImageError, match="object.npy: expected numbers, got an array of Python objects; save an"):
        read_observation(tmp_path / "object.npy", MINI)
    with pytest.raises(ImageError, match="expected one image, got 2 pages"):
        read_observation(write(tmp_path / "stack.tif", np.zeros((2, *SHAPE), np.float32)), MINI)
    monkeypatch.setattr("geomtact.sensing.image_file.MAX_BYTES", 100)
    with pytest.raises(ImageError, match="is it one image"):
        read_observation(write(tmp_path / "mask.png", MASK * np.uint8(255)), MINI)
    monkeypatch.setattr("geomtact.sensing.image_file.MAX_BYTES", 2**20)
    monkeypatch.setattr("geomtact.sensing.image_codecs.MAX_PIXELS", 100)
    with pytest.raises(ImageError, match="320 x 240 px is more than"):
        read_observation(tmp_path / "mask.png", MINI)


# ---------------------------------------------------------------- writing


@pytest.mark.parametrize("array", [MASK, HEIGHT])
def test_a_written_image_is_loaded_with_its_metadata(tmp_path, array):
    T = np.eye(4)
    T[:3, 3] = [1e-3, -2.5e-3, 0.1 + 1e-17]
    path = tmp_path / "touch.png"
    write_image(path, array, {"object": "hex-nut", "geomtact:sensor": "gelsight-mini", "T_sensor_object": T})
    contact = read_observation(path, MINI).contact
    assert np.array_equal(contact.mask, MASK)
    assert (contact.height is None) if array is MASK else np.abs(contact.height - HEIGHT).max() < 0.51e-6
    found = ImageFile.read(path).metadata
    assert found.keys() == {"geomtact:object", "geomtact:sensor", "geomtact:T_sensor_object"}
    assert found["geomtact:object"] == "hex-nut" and found["geomtact:sensor"] == "gelsight-mini"
    assert np.array_equal(found["geomtact:T_sensor_object"], T), "a pose survives to the last bit"
    assert [p.name for p in tmp_path.iterdir()] == ["touch.png"], "no partial file is left"


def test_metadata_of_other_files_is_empty_and_a_broken_pose_is_named(tmp_path, background):
    assert ImageFile.read(write(tmp_path / "plain.png", background)).metadata == {}
    assert ImageFile.read(write(tmp_path / "plain.jpg", background)).metadata == {}
    write_image(tmp_path / "wrong.png", MASK, {"T_sensor_object": 2 * np.eye(4)})
    with pytest.raises(ImageError, match="geomtact:T_sensor_object is no rigid transform"):
        ImageFile.read(tmp_path / "wrong.png").metadata  # noqa: B018


@pytest.mark.parametrize("value", [0, 255])
def test_a_camera_without_light_shows_no_mask(background, value):
    """Beside a background an image of one value is a camera's; without one it may be a mask of nothing, or of all."""
    for frame in (np.full_like(background, value), np.full(SHAPE, value, np.uint8)):
        with pytest.raises(ImageError, match=f"image: every pixel is {value}, as of a camera without light"):
            read_observation(frame, MINI, background=background)
        with pytest.raises(ImageError, match=f"background: every pixel is {value}, as of a camera without light"):
            read_observation(background, MINI, background=frame)
    assert read_observation(np.full(SHAPE, value, np.uint8), MINI).kind == "mask"


def test_a_mask_that_is_hardly_a_touch_is_a_warning(rng):
    dot = np.zeros(SHAPE, bool)
    dot[100, 100] = True
    rows, columns = np.indices(SHAPE)
    knurl = (rows % 16 < 6) & (columns % 16 < 6)  # 300 tips of 0.38 mm, 1 mm apart
    noise, mostly, dirt = (rng.random(SHAPE) < share for share in (0.3, 0.9, 0.003))
    doubts = [("as dust does", dot), ("if that is where nothing touches, invert it", ~MASK)]
    small, at_the_border = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    small[100:110, 100:120] = at_the_border[:30, 40:70] = True
    doubts += [("if that is where nothing touches, invert it", ~mask) for mask in (small, at_the_border)]
    doubts += [("specks and holes as small as dust", mask) for mask in (noise, mostly, MASK | dirt)]
    for said, mask in doubts:
        (warning,) = read_observation(mask, MINI).warnings
        assert said in warning
    for mask in (MASK, knurl):
        assert read_observation(mask, MINI).warnings == []


def test_what_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(ImageError, match=r"expected 0 to 0.0655 m, got 0 to \S+; give metres"):
        write_image(tmp_path / "h.png", HEIGHT * 1e3)
    with pytest.raises(ImageError, match="cannot write int64"):
        write_image(tmp_path / "h.png", np.zeros(SHAPE, np.int64))
    with pytest.raises(ImageError, match=r"cannot be written \(No such file or directory\)"):
        write_image(tmp_path / "nowhere" / "h.png", MASK)
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- contact_mask


def test_a_dent_is_found_where_it_is_whatever_the_light_does(background, rng):
    for x, y, r in ((80, 70, 25), (200, 150, 45), (10, 120, 40), (310, 230, 50)):
        image = press(background, x, y, r, rng)
        brighter = np.clip(image * [1.08, 0.95, 1.02] + [3, 5, -4], 0, 255).astype(np.uint8)
        for reading in (image, brighter):
            iou, centre = agreement(contact_mask(reading, background, MINI), disk(x, y, r))
            assert iou > 0.85 and centre < 2.5


@pytest.mark.parametrize("method", ["classical", "pressure"])
def test_a_finer_camera_sees_the_same_contact(background, rng, method):
    image, fine = press(background, 200, 90, 40, rng), (640, 480)
    mask = contact_mask(image, background, method=method)
    finer = contact_mask(*(cv2.resize(each, fine) for each in (image, background)), method=method)
    assert finer.shape == fine[::-1]
    same = cv2.resize(mask.astype(np.uint8), fine).astype(bool)
    assert (same & finer).sum() > 0.98 * (same | finer).sum()


def test_light_drift_and_noise_are_no_contact(background, rng):
    for gain, offset, noise in ((1, 0, 0), (1, 0, 7), (1.1, -6, 3), (0.9, 5, 5)):
        image = np.clip(background * gain + offset + rng.normal(0, noise, background.shape), 0, 255).astype(np.uint8)
        assert not contact_mask(image, background).any()
        assert not contact_mask(image).any(), "nor is a smooth light without a background"


def test_two_dents_are_two_components(background, rng):
    from scipy import ndimage

    image = press(press(background, 80, 120, 35, rng), 240, 110, 35, rng)
    mask = contact_mask(image, background)
    assert ndimage.label(mask)[1] == 2
    assert agreement(mask, disk(80, 120, 35) | disk(240, 110, 35))[0] > 0.8


def agreement(mask: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Intersection over union, and the distance of the centroids in pixels."""
    if not mask.any():
        return 0.0, np.inf
    offset = np.argwhere(mask).mean(0) - np.argwhere(truth).mean(0)
    return (mask & truth).sum() / (mask | truth).sum(), float(np.hypot(*offset))


def test_real_gelsight_mini_presses_lie_on_the_circles_drawn_by_eye(data_folder):
    folder = data_folder / "gelslam_gsmini_balls"
    with (Path(__file__).parent / "circles_gelslam_gsmini.csv").open() as file:
        circles = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert len(circles) == 44 and sum(c["inside"] == "1" for c in circles) == 29
    background = read_image(folder / "background.png")
    found = {"1": [], "0": []}
    for circle in circles:
        truth = disk(float(circle["cx_px"]), float(circle["cy_px"]), float(circle["r_px"]))
        mask = read_observation(folder / circle["file"], MINI, background=background).contact.mask
        iou, centre = agreement(mask, truth)
        far = mask & ~disk(float(circle["cx_px"]), float(circle["cy_px"]), 1.6 * float(circle["r_px"]))
        assert not far.any(), f"{circle['file']}: contact far from the ball"
        found[circle["inside"]].append((iou, centre * 0.0634))
    inside, border = np.array(found["1"]), np.array(found["0"])
    assert np.median(inside[:, 0]) > 0.87 and inside[:, 0].min() > 0.74
    assert np.median(inside[:, 1]) < 0.2 and np.quantile(inside[:, 1], 0.85) < 0.3 and inside[:, 1].max() < 0.42
    assert np.median(border[:, 0]) > 0.88 and border[:, 1].max() < 0.5
    assert not contact_mask(background, background).any()


def test_the_classical_method_agrees_with_their_makers_circles_on_other_real_gels(data_folder):
    """A soft gel (FOTS) bulges far beyond the ball's contact: there only the place is right."""
    sets = imprints(data_folder)
    soft, firm = (
        np.array(
            [agreement(contact_mask(i.image, i.background, method="classical"), disk(*i.circle, shape)) for i in some]
        )
        for some, shape in ((sets["fots"], (320, 240)), (sets["objectfolder"], (120, 160)))
    )
    iou, centre = firm.T
    assert np.median(iou) > 0.82 and iou.min() > 0.7
    assert np.median(centre) * 0.1245 < 0.25 and centre.max() * 0.1245 < 0.52
    iou, centre = soft.T
    assert np.median(centre) * 0.0511 < 0.55 and centre.max() * 0.0511 < 0.9 and iou.min() > 0.28
    for some in sets.values():
        assert not contact_mask(some[0].background, some[0].background, method="classical").any()


@pytest.mark.parametrize("name", ["fots", "objectfolder"])
@pytest.mark.parametrize(
    ("method", "overlap", "least", "off", "farthest"),
    [("auto", 0.82, 0.66, 0.02, 0.05), ("pressure", 0.77, 0.65, 0.03, 0.08)],
)
def test_other_real_gels_agree_with_their_makers_circles(data_folder, name, method, overlap, least, off, farthest):
    """Of balls on a soft gel and a firm one, with one channel blown out: an imprint is a little wider than the contact."""
    drawn = imprints(data_folder)[name]
    found = find(drawn, method, partial(contact_mask, method=method))
    iou, centre = (np.array([getattr(each, value) for each in found]) for value in ("iou", "centre"))
    assert np.median(iou) > overlap and iou.min() > least
    assert np.median(centre) < off and centre.max() < farthest
    assert method != "auto" or all(0.95 < each.factor < 1.2 for each in found)
    assert not contact_mask(drawn[0].background, drawn[0].background, method=method).any()


def test_a_white_gel_is_touched_where_it_darkens(data_folder):
    """One press of a ball of 4 mm radius: a contact that is round, no wider than the ball, and has no bright halo in it."""
    folder = data_folder / "ninedtact_calib" / "sensor_1" / "depth_calibration"
    image, background = read_image(folder / "sample.png"), read_image(folder / "ref.png")
    mask = contact_mask(image, background, "9dtact")
    rows, columns = np.nonzero(mask)
    radius = np.sqrt(mask.sum() / np.pi)
    assert agreement(mask, disk(columns.mean(), rows.mean(), radius, mask.shape))[0] > 0.95
    assert 1.5 < radius * 0.0515 < 4.0
    darker = (background.astype(float) - image).sum(-1)
    assert darker[mask].min() > 0


def test_the_real_digit_without_contact_shows_none(data_folder, rng):
    background = read_image(data_folder / "fots_balls" / "digit_bg.png")
    assert not contact_mask(background, background, "digit").any()
    again = np.clip(background * 1.03 - 2 + rng.normal(0, 3, background.shape), 0, 255).astype(np.uint8)
    assert not contact_mask(again, background, "digit").any()
    assert contact_mask(read_image(data_folder / "fots_balls" / "digit" / "0041.png"), background, "digit").any()


def test_simulated_digit_images_give_rounded_patches(data_folder):
    """Of 20 images all but two of one edge: one patch that holds most of the mask, without holes, near the contact on the axis.

    Of that edge the network finds the two flanks.
    """
    from scipy import ndimage

    folder = data_folder / "hsp_digit_sim_ycb"
    background = read_image(folder / "background.png")
    readings = sorted(folder.glob("*/triplet_*/Image_heatmap_1.png"))
    assert len(readings) == 20
    split = 0
    for path in readings:
        mask = read_observation(path, "digit-hsp", background=background).contact.mask
        labels, _ = ndimage.label(mask)
        largest = labels == 1 + np.argmax(np.bincount(labels[labels > 0])[1:])
        split += largest.sum() <= 0.9 * mask.sum()
        assert largest.sum() > 0.015 * mask.size and np.array_equal(ndimage.binary_fill_holes(mask), mask)
        assert ndimage.distance_transform_edt(~mask)[160, 120] < 40
    assert split <= 2
