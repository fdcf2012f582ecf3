"""Image files: read as they are in RGB order, with one clear error each; written with the touch's metadata."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.errors import ImageError, PoseError
from geomtact.files import printable, write_whole
from geomtact.se3 import check_transforms
from geomtact.sensing.image_codecs import SUPPORTED, decoded

MAX_BYTES = 256 * 2**20
_PREFIX = "geomtact:"


@dataclass(frozen=True, eq=False)
class ImageFile:
    """The bytes of an image file, read once: its pixels, and what geomtact wrote beside them."""

    path: Path
    data: bytes

    @classmethod
    def read(cls, path: str | Path) -> ImageFile:
        """The file ``path``.

        Raises
        ------
        ImageError
            No such file, empty or too large.
        """
        return cls(Path(path), _read_bytes(Path(path)))

    @cached_property
    def pixels(self) -> NDArray[Any]:
        """As :func:`read_image`."""
        return decoded(self.data, self.path)

    @cached_property
    def metadata(self) -> dict[str, Any]:
        """What ``geomtact simulate`` wrote into a PNG, under the keys it has there; {} where there is nothing.

        ``geomtact:object``, ``geomtact:unit`` and ``geomtact:sensor`` are strings, ``geomtact:T_sensor_object`` is (4, 4) [m].
        """
        from PIL import Image, UnidentifiedImageError

        if self.data[:8] != b"\x89PNG\r\n\x1a\n":
            return {}
        try:
            with Image.open(io.BytesIO(self.data)) as image:
                image.load()
                text = dict(getattr(image, "text", {}))
        except (OSError, SyntaxError, ValueError, UnidentifiedImageError, Image.DecompressionBombError) as error:
            raise ImageError(
                f"{self.path}: the image is truncated or damaged ({error}); save or copy it again"
            ) from None
        found: dict[str, Any] = {key: value for key, value in text.items() if key.startswith(_PREFIX)}
        pose = f"{_PREFIX}T_sensor_object"
        if pose in found:
            try:
                found[pose] = check_transforms(json.loads(found[pose]), pose)
            except (ValueError, TypeError, PoseError) as error:
                raise ImageError(
                    f"{self.path}: its entry {pose} is no rigid transform ({error}); write it again"
                ) from None
        return found


def read_image(path: str | Path) -> NDArray[Any]:
    """The pixels of an image file: (H, W) or (H, W, C), colours in the order R, G, B(, A).

    They are as stored, but for those of a palette, which are its colours, and of a TIFF file in which 0 is white.

    Raises
    ------
    ImageError
        No such file, empty, too large, no image, or damaged.
    """
    return ImageFile.read(path).pixels


def write_image(path: str | Path, array: ArrayLike, metadata: Mapping[str, Any] | None = None) -> None:
    """Write a PNG: a mask as 0/255, a depth map [m] as 16-bit micrometres, an RGB image (uint8) as it is.

    ``metadata``: ``object``, ``unit``, ``sensor``, ``T_sensor_object`` (4, 4), with or without the prefix ``geomtact:`` that they
    carry in the file.
    """
    from PIL import Image, PngImagePlugin

    array = np.asarray(array)
    if array.dtype == bool and array.ndim == 2:
        pixels = np.where(array, 255, 0).astype(np.uint8)
    elif array.dtype.kind == "f" and array.ndim == 2:
        if not np.isfinite(array).all() or array.min(initial=0) < 0 or array.max(initial=0) > 0.0655:
            raise ImageError(
                f"depths to write: expected 0 to 0.0655 m, got {array.min():g} to {array.max():g}; give metres"
            )
        pixels = np.round(array * 1e6).astype(np.uint16)
    elif array.dtype == np.uint8 and array.ndim in (2, 3):
        pixels = array
    else:
        raise ImageError(f"cannot write {array.dtype} {array.shape}: give a bool mask, float depths [m] or uint8 RGB")
    info = PngImagePlugin.PngInfo()
    for key, value in (metadata or {}).items():
        text = value if isinstance(value, str) else json.dumps(np.asarray(value).tolist())
        info.add_text(_PREFIX + key.removeprefix(_PREFIX), printable(text))
    path = Path(path)
    try:
        write_whole(path, lambda temporary: Image.fromarray(pixels).save(temporary, format="PNG", pnginfo=info))
    except OSError as error:
        raise ImageError(f"{path}: cannot be written ({error.strerror or error}); give another folder") from None


def _read_bytes(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if path.is_dir():
            raise ImageError(f"{path}: expected an image file, got a folder; {SUPPORTED}")
        if size == 0:
            raise ImageError(f"{path}: the file is empty (0 bytes); {SUPPORTED}")
        if size > MAX_BYTES:
            raise ImageError(f"{path}: {size / 2**20:.0f} MiB, more than {MAX_BYTES / 2**20:.0f} MiB; is it one image?")
        return path.read_bytes()
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file; give the path of an image") from None
    except OSError as error:
        raise ImageError(
            f"{path}: cannot be read ({error.strerror or error}); check the file and its permissions"
        ) from None
