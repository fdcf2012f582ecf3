"""Masks as people keep them: palettes, two colours, compressed TIFF, and videos."""

import io
import struct

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from geomtact.cli.frames import all_frames
from geomtact.errors import ImageError
from geomtact.sensing.image_file import read_image
from geomtact.sensing.reading import read_observation
from geomtact.sensing.sensor import Sensor

MINI = Sensor.load("gelsight-mini")
ROWS, COLUMNS = np.mgrid[:240, :320]
MASK = (COLUMNS - 200) ** 2 + (ROWS - 90) ** 2 <= 40**2
NOTHING = np.zeros_like(MASK)
GREY = 255 * MASK.astype(np.uint8)
COLOUR = np.dstack([ROWS, COLUMNS % 256, (3 * ROWS + COLUMNS) % 251]).astype(np.uint8)
HEIGHT = np.where(MASK, 5e-4 - 1e-7 * (COLUMNS - 200) ** 2, 0).astype(np.float32)
VOC = [0, 0, 0, 128, 0, 0, 0, 128, 0]


def palette(mask, colours, background=0, contact=1):
    """A palette image (H, W) of colours one after the other, R, G, B."""
    image = Image.fromarray(np.where(mask, contact, background).astype(np.uint8), "P")
    image.putpalette(colours)
    return image


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif"])
@pytest.mark.parametrize("mask", [MASK, NOTHING])
@pytest.mark.parametrize(
    ("colours", "background", "contact"),
    [
        pytest.param(VOC, 0, 1, id="VOC"),
        pytest.param(VOC, 0, 2, id="VOC's second class"),
        pytest.param([0, 0, 0, 255, 255, 255], 0, 1, id="black and white"),
        pytest.param([255, 0, 0, 0, 0, 0], 1, 0, id="black is second"),
        pytest.param([255, 255, 255, 255, 0, 0], 0, 1, id="red on white"),
    ],
)
def test_a_palette_of_two_colours_is_a_mask(tmp_path, suffix, mask, colours, background, contact):
    palette(mask, colours, background, contact).save(tmp_path / f"mask.{suffix}")
    for kind in ("auto", "mask"):
        seen = read_observation(tmp_path / f"mask.{suffix}", MINI, kind=kind)
        assert seen.kind == "mask" and seen.warnings == [] and np.array_equal(seen.contact.mask, mask)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif"])
@pytest.mark.parametrize("mask", [MASK, NOTHING, ~NOTHING])
@pytest.mark.parametrize("colours", [None, [0, 0, 0], [0] * 6, [9, 9, 9] * 2], ids=["none", "one", "black", "grey"])
def test_a_palette_with_equal_colours_counts_by_index(tmp_path, suffix, mask, colours):
    image = Image.fromarray(mask.astype(np.uint8), "P")
    if colours is not None:
        image.putpalette(colours)
    image.save(tmp_path / f"mask.{suffix}")
    if suffix == "bmp" and (colours is None or len(colours) == 3):
        with pytest.raises(ImageError, match="mask.bmp: its palette has one colour only; save it as a grey PNG"):
            read_observation(tmp_path / "mask.bmp", MINI)
        return
    seen = read_observation(tmp_path / f"mask.{suffix}", MINI, kind="mask")
    assert np.array_equal(seen.contact.mask, mask)


def test_a_palette_of_many_colours_is_an_image(tmp_path):
    """Two of which may be alike."""
    image = Image.fromarray(COLOUR).quantize(200)
    image.putpalette([*image.getpalette()[:597], *image.getpalette()[:3]])
    image.save(tmp_path / "image.png")
    assert np.array_equal(read_image(tmp_path / "image.png"), np.asarray(image.convert("RGB")))


def test_two_indices_of_the_colour_of_no_contact_are_refused(tmp_path):
    image = Image.fromarray((MASK + 2 * (COLUMNS < 20)).astype(np.uint8), "P")
    image.putpalette([0, 0, 0, 255, 255, 255, 0, 0, 0])
    for suffix in ("png", "tif"):
        image.save(tmp_path / f"mask.{suffix}")
        with pytest.raises(
            ImageError, match=f"mask.{suffix}: its palette shows the indices 0 and 2 alike; save a grey PNG"
        ):
            read_image(tmp_path / f"mask.{suffix}")


def test_indices_of_equal_palette_colours_are_refused_without_a_0(tmp_path):
    palette(MASK, [0] * 9, 1, 2).save(tmp_path / "mask.png")
    with pytest.raises(ImageError, match="got nothing but 1 and 2; draw contact white"):
        read_observation(tmp_path / "mask.png", MINI)


@pytest.mark.parametrize("suffix", ["gif", "png", "webp"])
def test_several_frames_in_one_file_are_refused(tmp_path, suffix):
    path, (first, *others) = tmp_path / f"frames.{suffix}", [Image.fromarray(np.roll(COLOUR, i)) for i in range(3)]
    first.save(path, save_all=True, append_images=others)
    with pytest.raises(ImageError, match=f"frames.{suffix}: expected one image, got 3 frames; save one frame"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("orientation", [0, *range(1, 10)])
def test_an_orientation_tag_other_than_upright_is_refused(tmp_path, suffix, orientation):
    path, exif = tmp_path / f"turned.{suffix}", Image.Exif()
    exif[274] = orientation
    Image.fromarray(COLOUR).save(path, exif=exif)
    if orientation in (0, 1, 9):
        assert read_image(path).shape == COLOUR.shape
        return
    message = (
        f"its orientation tag, {orientation}, turns or mirrors the stored pixels; save them as the camera gives them, and "
        "remove the tag or set it to 1"
    )
    with pytest.raises(ImageError, match=f"turned.{suffix}: {message}"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize("exif", [b"Exif\0\0no such thing", b"Exif\0\0II*\0", b"Exif\0\0"])
def test_damaged_metadata_are_overlooked(tmp_path, suffix, exif):
    Image.fromarray(COLOUR).save(tmp_path / f"image.{suffix}", exif=exif)
    assert read_image(tmp_path / f"image.{suffix}").shape == COLOUR.shape


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.int64])
def test_whole_numbers_of_0_and_one_below_are_a_mask(tmp_path, dtype):
    array = -MASK.astype(dtype)
    np.save(tmp_path / "mask.npy", array)
    tifffile.imwrite(tmp_path / "mask.tif", array)
    for given in (array, tmp_path / "mask.npy", tmp_path / "mask.tif"):
        for kind in ("auto", "mask"):
            seen = read_observation(given, MINI, kind=kind)
            assert seen.kind == "mask" and seen.warnings == [] and np.array_equal(seen.contact.mask, MASK)
    with pytest.raises(ImageError, match="image: .*nothing but -3 and 5"):
        read_observation(np.where(MASK, 5, -3).astype(dtype), MINI)


@pytest.mark.parametrize("colour", [(255, 0, 0), (0, 128, 0), (200, 200, 255)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64, np.float32])
def test_black_and_one_colour_is_a_mask(colour, dtype):
    image = np.where(MASK[..., None], colour, 0).astype(dtype)
    opaque = np.full(MASK.shape, 1 if dtype is np.float32 else np.iinfo(dtype).max, dtype)
    for given in (image, np.dstack([image, opaque])):
        seen = read_observation(given, MINI)
        assert seen.kind == "mask" and np.array_equal(seen.contact.mask, MASK)


@pytest.mark.parametrize(
    ("image", "given"),
    [
        (np.where(MASK[..., None], [255, 0, 0], [255, 255, 255]), r"nothing but \(255, 0, 0\) and \(255, 255, 255\)"),
        (np.where(MASK[..., None], [128, 0, 0], [0, 0, 0]) + (COLUMNS == 7)[..., None] * [0, 9, 0], "4 colours|3 colours"),
        (np.where(MASK, 200, 50), "nothing but 50 and 200"),
        (np.where(MASK, 2, 1), "nothing but 1 and 2"),
        (np.full((*MASK.shape, 3), [9, 8, 7]), r"nothing but \(9, 8, 7\)"),
    ],
)  # fmt: skip
def test_other_drawings_are_refused(image, given):
    message = (
        f"image: expected a camera's image, or a mask that is black where nothing touches, got ({given}); draw contact"
    )
    for kind in ("auto", "mask"):
        with pytest.raises(ImageError, match=message):
            read_observation(image.astype(np.uint8), MINI, kind=kind)
    assert read_observation(np.where(MASK, 200, 50).astype(np.uint8), MINI, kind="reading").kind == "reading"


def test_the_noise_of_a_camera_without_light_is_no_drawing(rng):
    dark = rng.integers(0, 2, (240, 320, 3), np.uint8)
    dark[..., 2] = 0
    seen = read_observation(dark, MINI)
    assert seen.kind == "reading" and any("black in 100 % of its pixels" in warning for warning in seen.warnings)


def test_a_mask_is_0_where_nothing_touches():
    with pytest.raises(ImageError, match="a mask is 0 where nothing touches, got 1 to 3; set it to 0"):
        read_observation(np.where(MASK, 3, 1 + (ROWS > 9)), MINI, kind="mask")


def tiff(array, by="pillow", **options):
    out = io.BytesIO()
    if by == "pillow":
        Image.fromarray(array).save(out, "TIFF", **options)
    else:
        tifffile.imwrite(out, array, **options)
    return out.getvalue()


def opencv(array, compression):
    image = array[..., ::-1] if array.ndim == 3 else array
    return cv2.imencode(".tif", image, [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes()


def with_0_white(data):
    """A TIFF file whose zeros mean white."""
    out = io.BytesIO(data)
    with tifffile.TiffFile(out, mode="r+") as file:
        file.pages[0].tags["PhotometricInterpretation"].overwrite(0)
        return out.getvalue()


def packed(indices, bits, photometric):
    """An uncompressed TIFF file of whole numbers (240, 320) of less than 8 bits, with the palette RED if it is one."""
    bytes_ = np.packbits(np.unpackbits(indices.astype(np.uint8)[..., None], -1)[..., 8 - bits :].reshape(240, -1), 1)
    tags = {256: 320, 257: 240, 258: bits, 259: 1, 262: photometric, 273: 2000, 277: 1, 278: 240, 279: bytes_.size}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    colours = RED[:, : 2**bits].astype("<u2").tobytes() if photometric == 3 else b""
    entries += struct.pack("<HHII", 320, 3, len(colours) // 2, 500) if colours else b""
    head = b"II*\0" + struct.pack("<IH", 8, len(entries) // 12) + entries + bytes(4)
    return (head.ljust(500, b"\0") + colours).ljust(2000, b"\0") + bytes_.tobytes()


RED = np.zeros((3, 256), np.uint16)
RED[0, 1] = 128
COLOURED = np.dstack([MASK * np.uint8(128), 0 * GREY, 0 * GREY])
WIDE = COLOUR.astype(np.uint16) * 257 + 3
TIFFS = {
    "LZW": (tiff(GREY, compression="tiff_lzw"), GREY),
    "LZW, 1 bit": (tiff(MASK, compression="tiff_lzw"), MASK),
    "LZW, colour": (tiff(COLOUR, compression="tiff_lzw"), COLOUR),
    "LZW, 16 bits": (tiff(COLOUR[..., 0].astype(np.uint16) * 9, compression="tiff_lzw"), COLOUR[..., 0].astype(np.uint16) * 9),
    "LZW, 16 bits of colour": (opencv(WIDE, 5), WIDE),
    "LZW, float": (tiff(HEIGHT, compression="tiff_lzw"), HEIGHT),
    "LZW, float, predictor": (opencv(HEIGHT, 5), HEIGHT),
    "deflate, float, predictor": (opencv(HEIGHT, 8), HEIGHT),
    "deflate": (tiff(GREY, "tifffile", compression="zlib", predictor=True), GREY),
    "ZSTD": (tiff(GREY, compression="zstd"), GREY),
    "Group 3": (tiff(MASK, compression="group3"), MASK),
    "Group 4": (tiff(MASK, compression="group4"), MASK),
    "PackBits": (tiff(GREY, compression="packbits"), GREY),
    "JPEG": (tiff(GREY, compression="jpeg"), GREY),
    "big endian": (tiff(HEIGHT, "tifffile", byteorder=">"), HEIGHT),
    "tiles": (tiff(COLOUR, "tifffile", tile=(16, 32)), COLOUR),
    "planes": (tiff(np.moveaxis(COLOUR, -1, 0), "tifffile", planarconfig="separate", photometric="rgb"), COLOUR),
    "bool of tifffile": (tiff(MASK, "tifffile"), MASK),
    "0 is white": (tiff(255 - GREY, "tifffile", photometric="miniswhite"), GREY),
    "0 is white, 1 bit": (tiff(MASK, tiffinfo={262: 0}), MASK),
    "0 is white, 1 bit of LZW": (with_0_white(tiff(~MASK, compression="tiff_lzw")), MASK),
    "0 is white, float": (with_0_white(tiff(HEIGHT, "tifffile")), HEIGHT),
    "bool of tifffile, named": (tiff(MASK, "tifffile", software="a lab"), MASK),
    "bool of tifffile, bare": (tiff(MASK, "tifffile", metadata=None, software=False), MASK),
    "bool of tifffile, tiles": (tiff(MASK, "tifffile", tile=(16, 32), software="a lab"), MASK),
    "2 bits": (packed(MASK, 2, 1), MASK * np.uint8(85)),
    "4 bits": (packed(MASK, 4, 1), MASK * np.uint8(17)),
    "1 bit of a palette": (packed(MASK, 1, 3), COLOURED),
    "2 bits of a palette": (packed(MASK, 2, 3), COLOURED),
    "4 bits of a palette": (packed(MASK, 4, 3), COLOURED),
    "8 bits of a palette of 8 bits": (tiff(MASK.astype(np.uint8), "tifffile", photometric="palette", colormap=RED), COLOURED),
    "8 bits of a palette of 16 bits": (
        tiff(MASK.astype(np.uint8), "tifffile", photometric="palette", colormap=RED * 257), COLOURED),
    "0 is white, Group 4": (with_0_white(tiff(~MASK, compression="group4")), MASK),
    "0 is white, LZW": (with_0_white(tiff(255 - GREY, compression="tiff_lzw")), GREY),
}  # fmt: skip


@pytest.mark.parametrize("form", TIFFS)
def test_every_usual_tiff_is_read(tmp_path, form):
    data, array = TIFFS[form]
    path = tmp_path / "image.tif"
    path.write_bytes(data)
    read = read_image(path)
    if array is MASK or form == "JPEG":
        read, array = read > np.iinfo(read.dtype).max // 2 if read.dtype == np.uint8 else read, MASK
    assert read.dtype == array.dtype and np.array_equal(read, array)
    path.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(ImageError, match="image.tif: "):
        read_image(path)


def test_a_tiff_of_other_bits_is_refused_in_plain_words(tmp_path):
    path = tmp_path / "image.tif"
    path.write_bytes(packed(MASK, 3, 1))
    with pytest.raises(ImageError) as error:
        read_image(path)
    assert (
        str(error.value)
        == f"{path}: a TIFF file of 3 bits (uint8) that is not read; save 8 or 16 bits, or float32, uncompressed"
    )


def test_the_samples_are_masks(data_folder):
    for name in ("voc.png", "lzw.tif"):
        seen = read_observation(data_folder / "inputs" / name, MINI)
        assert seen.kind == "mask" and seen.warnings == [] and seen.contact.mask.sum() == 2933


@pytest.mark.parametrize(("suffix", "codec"), [("avi", "MJPG"), ("mp4", "mp4v")])
def test_a_video_of_masks_is_cut_at_half(tmp_path, suffix, codec):
    """Compression leaves noise all around, which would be contact where all but 0 is."""
    path = tmp_path / f"masks.{suffix}"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 10, (320, 240))
    masks = [np.roll(MASK, 4 * i, 1) for i in range(4)] + [NOTHING]
    for mask in masks:
        video.write(cv2.cvtColor(255 * mask.astype(np.uint8), cv2.COLOR_GRAY2BGR))
    video.release()
    frames = list(all_frames(str(path), masks=True))
    assert len(frames) == 5
    for frame, mask in zip(frames, masks, strict=True):
        seen = read_observation(frame.image, MINI, kind="mask")
        assert seen.warnings == [] and (seen.contact.mask != mask).sum() <= 0.01 * MASK.sum()
    # an array in Python, of whatever origin
    colours = next(iter(all_frames(str(path)))).image
    seen = read_observation(colours, MINI, kind="mask")
    assert (seen.contact.mask != MASK).sum() <= 0.01 * MASK.sum() and "what is over half counts" in seen.warnings[0]
    assert "for a mask give --kind mask" in read_observation(colours, MINI).warnings[0]


def test_a_video_of_tactile_images_is_no_video_of_masks(tmp_path):
    path = tmp_path / "readings.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (320, 240))
    video.write(COLOUR)
    video.release()
    (frame,) = all_frames(str(path), masks=True)
    with pytest.raises(ImageError, match="a mask has one channel, got a colour image"):
        read_observation(frame.image, MINI, kind="mask")
