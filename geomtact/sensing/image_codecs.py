"""The pixels behind the bytes of an image file: which library reads which kind, and what the stored numbers mean."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import ImageError
from geomtact.sensing.drawn import SEEN

MAX_PIXELS = 64 * 2**20
SUPPORTED = "give a PNG, JPEG, BMP, TIFF or .npy file"
# of TIFF: compressions that tifffile decodes by itself (none, deflate, PackBits, LZMA), the predictor that it does not (of
# floats), and photometric interpretations
_OWN_COMPRESSIONS, _FLOATS = (1, 8, 32946, 32773, 34925), 3
_ZERO_IS_WHITE, _PALETTE = 0, 3
_BITS_PER_SAMPLE, _ORIENTATION, _PLANAR = 258, 274, 284  # numbers of tags
_MODES = ("1", "L", "I", "F", "I;16", "I;16B", "LA", "RGB", "RGBA")  # of Pillow, whose pixels are what they say


def decoded(data: bytes, path: Path) -> NDArray[Any]:
    """The pixels (H, W) or (H, W, C), colours in the order R, G, B(, A), in the bytes of the file ``path``.

    Raises
    ------
    ImageError
        It is no image, one of too many pixels, of several pages, or damaged.
    """
    if data[:6] == b"\x93NUMPY":
        return _read_npy(data, path)
    if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _read_tiff(data, path)
    return _read_coded(data, path)


def _read_npy(data: bytes, path: Path) -> NDArray[Any]:
    if b"'|O'" in data[:128]:
        raise ImageError(
            f"{path}: expected numbers, got an array of Python objects; save an array of bool, int or float"
        )
    try:
        return np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as error:  # noqa: BLE001 -- the header is parsed as Python, which fails in more ways than are documented
        raise ImageError(
            f"{path}: not a whole .npy array of numbers ({error}); save it again with numpy.save"
        ) from None


def _read_tiff(data: bytes, path: Path) -> NDArray[Any]:
    import tifffile

    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            if len(file.pages) == 0:
                raise ImageError(f"{path}: the TIFF file is damaged (no page in it); save it again")
            if len(file.pages) > 1:
                raise ImageError(f"{path}: expected one image, got {len(file.pages)} pages; save one page")
            page: Any = file.pages[0]
            _check_pixels(path, page.imagewidth, page.imagelength)
            _check_upright(path, page.tags.valueof(_ORIENTATION, 1))
            own = page.compression in _OWN_COMPRESSIONS and page.predictor != _FLOATS
            if page.photometric <= _PALETTE and own and page.bitspersample in (1, 8, 16, 32, 64):
                return _as_meant(page, path)
            # the other libraries decode the rest, but Pillow rounds colours to 8 bits
            by_opencv = page.samplesperpixel > 1 and page.bitspersample > 8
            return _by_opencv(data, path) if by_opencv else _by_pillow(data, path, page)
    except ImageError:
        raise
    except Exception as error:  # noqa: BLE001  (tifffile raises whatever its codecs raise)
        raise ImageError(
            f"{path}: the TIFF file is damaged, or of a kind that is not read ({error}); save it again, uncompressed"
        ) from None


def _as_meant(page: Any, path: Path) -> NDArray[Any]:
    """The pixels that a page of a TIFF file, read by tifffile, means by what it stores."""
    image = page.asarray()
    if image.ndim == 3 and page.planarconfig == 2:
        return np.moveaxis(image, 0, -1)
    if page.photometric == _PALETTE:
        return _in_colours(image, _palette(page), path)
    # in bool arrays tifffile calls True black, which means contact here; it leaves out both tags, libtiff none, Pillow one
    by_tifffile = page.bitspersample == 1 and not {_BITS_PER_SAMPLE, _PLANAR} & {tag.code for tag in page.tags}
    if page.photometric == _ZERO_IS_WHITE and not by_tifffile and image.dtype.kind in "bu":
        return np.asarray(~image)
    return np.asarray(image)


def _palette(page: Any) -> NDArray[np.uint8]:
    """The colours (n, 3) of a TIFF page's palette, which has 16 bits, but where some programs write 8."""
    return np.asarray((page.colormap >> (8 if page.colormap.max() > 255 else 0)).T.astype(np.uint8))


def _in_colours(indices: NDArray[Any], palette: NDArray[np.uint8], path: Path) -> NDArray[Any]:
    """The colours (H, W, 3) of indices (H, W) into a palette (n, 3).

    The indices themselves, 0 for no contact, where these are 0 and at most one other, and neither is black; or where the palette
    lacks some, or shows all alike.

    Raises
    ------
    ImageError
        Of a few colours, another index has that of 0.
    """
    if indices.dtype == bool:
        indices = indices.view(np.uint8)
    used = np.unique(indices)
    colours = np.zeros((max(256, len(palette), int(used[-1]) + 1), 3), np.uint8)
    colours[: len(palette)] = palette
    n_colours = len(np.unique(colours[used], axis=0))
    drawn = used[0] == 0 and len(used) <= 2 and colours[used].any(1).all()
    like_0 = used[(used > 0) & (colours[used] == colours[0]).all(1)]
    alike = n_colours == 1 and len(used) + len(like_0) > 1
    if drawn or alike or used[-1] >= len(palette):
        return indices
    if len(like_0) and n_colours < SEEN:
        raise ImageError(
            f"{path}: its palette shows the indices 0 and {like_0[0]} alike; save a grey PNG, contact white"
        )
    return colours[indices]


def _read_coded(data: bytes, path: Path) -> NDArray[Any]:
    """PNG, JPEG, BMP and what else Pillow and OpenCV read."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data)) as header:
            _check_pixels(path, *header.size)
            # OpenCV fills what is missing of a truncated file with grey, without a warning
            header.load()
            if (n_frames := getattr(header, "n_frames", 1)) > 1:
                raise ImageError(f"{path}: expected one image, got {n_frames} frames; save one frame")
            _check_upright(path, _orientation(header))
            # of a BMP file with one colour (biClrUsed), Pillow and OpenCV read every index as that
            if header.format == "BMP" and data[46:50] == b"\1\0\0\0":
                raise ImageError(f"{path}: its palette has one colour only; save it as a grey PNG")
            if header.mode == "P" and "transparency" not in header.info:
                palette = np.array(header.getpalette("RGB"), np.uint8).reshape(-1, 3)
                return _in_colours(np.asarray(header), palette, path)
    except UnidentifiedImageError:
        raise ImageError(f"{path}: not an image; {SUPPORTED}") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ImageError(f"{path}: the image is truncated or damaged ({error}); save or copy it again") from None
    return _by_opencv(data, path)


def _by_pillow(data: bytes, path: Path, page: Any) -> NDArray[Any]:
    """What Pillow reads of a TIFF file with one ``page``."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data)) as image:
            image.load()
            if image.mode == "P":
                return _in_colours(np.asarray(image), _palette(page), path)
            return np.array(image if image.mode in _MODES else image.convert("RGB"))
    except UnidentifiedImageError:
        raise ImageError(
            f"{path}: a TIFF file of {page.bitspersample} bits ({page.dtype or 'no type'}) that is not read; save 8 or 16 bits, "
            "or float32, uncompressed"
        ) from None


def _by_opencv(data: bytes, path: Path) -> NDArray[Any]:
    """What OpenCV reads, as stored."""
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise ImageError(f"{path}: OpenCV cannot decode this image; {SUPPORTED}")
    if image.ndim == 3 and image.shape[2] >= 3:
        image = image[..., [2, 1, 0, *range(3, image.shape[2])]]
    return np.ascontiguousarray(image)


def _check_pixels(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise ImageError(
            f"{path}: {width} x {height} px is more than {MAX_PIXELS // 2**20} million; is it a sensor image?"
        )


def _orientation(image: Any) -> Any:
    """The orientation tag of an image that Pillow has read; 1 where its metadata are damaged, which viewers overlook."""
    try:
        return image.getexif().get(_ORIENTATION, 1)
    except Exception:  # noqa: BLE001  (the parser of EXIF data raises whatever it stumbles on)
        return 1


def _check_upright(path: Path, orientation: Any) -> None:
    """Refuse an image that viewers show turned or mirrored: whether its pixels are as the sensor saw them stays open."""
    if orientation in range(2, 9):
        raise ImageError(
            f"{path}: its orientation tag, {orientation}, turns or mirrors the stored pixels; save them as the camera gives "
            "them, and remove the tag or set it to 1"
        )
