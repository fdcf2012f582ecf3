"""The sensor: a camera behind a gel membrane, described by a TOML file.

The frame is the one of docs/conventions.md: origin at the image centre on the undeformed membrane, +x along
image columns, +y along rows, +z out towards the object. The camera sits at (0, 0, -camera_distance).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.errors import SensorError, did_you_mean, nearest_name
from geomtact.files import read_text
from geomtact.se3 import Array
from geomtact.sensing.colour import ColourTable
from geomtact.sensing.sensor_file import toml_text, toml_values

_OTHER_FORMATS = (".yaml", ".yml", ".json")  # of files that other makers' programs read
# m, of a sensor whose file does not state them. Over the second, 3 mm^2 of a depth map are one observation: of 1, 3 and 10 mm^2
# what leaves the largest gain on 60 touches of the pin, the head and the connector plug, seed 91.
HEIGHT_NOISE, HEIGHT_CORRELATION = 0.1e-3, 1e-3
CONTACT_METHODS = (
    "auto",
    "classical",
    "pressure",
    "learned",
)  # of finding the contact in a tactile image, the default first


_ALIKE = 0.02  # by which a camera's frame may be wider or narrower than the image that is cut out of it
ROTATIONS = (0, 90, 180, 270)  # degrees by which a camera may be turned


@dataclass(frozen=True)
class Sensor:
    """Geometry of a tactile sensor. Lengths are metres.

    Attributes
    ----------
    name : str
    image_size_px : (width, height) of the image, pixels
    pixel_pitch : (along x, along y) on the membrane at z = 0
    camera_distance : camera centre to membrane; 0 means orthographic
    max_penetration : how far an object can press into the gel
    membrane_radius : 0 means flat; otherwise the gel bulges towards the object with this radius
    housing_depth : how far the object may reach below z = 0 outside the window; None rules nothing out
    height_noise : standard deviation of its depths, beside a twentieth of each
    height_correlation : over what length their errors correlate: to 1/e
    contact_method : one of ``CONTACT_METHODS``, which finds the contact in its tactile images
    camera_rotation_deg : counter-clockwise rotation from the camera's image to the sensor's: 0, 90, 180 or 270; image_size_px is
        the size after it
    camera_mirrored : whether it is mirrored left to right before that
    camera_masks : whether masks and depth maps are given as the camera sees them, too, and not in the sensor frame
    driver_rotation_deg : by which the maker's driver turns what the camera delivers; images with width and height exchanged are
        taken to come straight from the camera, and are turned so before all else
    note : where the figures come from
    colour : the gel's slope by its colours; None where that is not calibrated
    border_fraction : share of the camera's frame that is cut off at each side before it is scaled to the image
    """

    name: str
    image_size_px: tuple[int, int]
    pixel_pitch: tuple[float, float]
    camera_distance: float
    max_penetration: float
    membrane_radius: float = 0.0
    housing_depth: float | None = None
    height_noise: float = field(default=HEIGHT_NOISE, compare=False)
    height_correlation: float = field(default=HEIGHT_CORRELATION, compare=False)
    contact_method: str = field(default=CONTACT_METHODS[0], compare=False)
    camera_rotation_deg: int = field(default=0, compare=False)
    camera_mirrored: bool = field(default=False, compare=False)
    camera_masks: bool = field(default=False, compare=False)
    driver_rotation_deg: int = field(default=0, compare=False)
    note: str = field(default="", compare=False)
    colour: ColourTable | None = field(default=None, compare=False)
    border_fraction: float = field(default=0.0, compare=False)

    def __post_init__(self) -> None:
        def need(ok: bool, what: str) -> None:
            if not ok:
                raise SensorError(f"sensor {self.name!r}: {what}")

        lengths = (
            *self.pixel_pitch,
            self.camera_distance,
            self.max_penetration,
            self.membrane_radius,
            self.height_noise,
            self.height_correlation,
        )
        need(
            not np.isinf([*lengths, self.housing_depth or 0]).any(),
            "a length is infinite; a file gives millimetres, Python metres",
        )
        need(bool(self.name.strip()), "name must not be empty")
        need(all(n >= 8 for n in self.image_size_px), f"image_size_px must be at least 8, got {self.image_size_px}")
        pitch_mm = [round(1e3 * p, 9) for p in self.pixel_pitch]
        need(all(p > 0 for p in self.pixel_pitch), f"pixel_pitch_mm must be positive, got {pitch_mm}")
        need(min(self.pixel_pitch) > 1e-6, f"pixel_pitch_mm {pitch_mm} is under a micrometre; give millimetres a pixel")
        need(self.max_penetration > 0, f"max_penetration_mm must be positive, got {1e3 * self.max_penetration:g}")
        need(
            self.camera_distance >= 0,
            f"camera_distance_mm must be >= 0 (0: parallel rays), got {1e3 * self.camera_distance:g}",
        )
        need(
            self.camera_distance == 0 or self.camera_distance > 2 * self.max_penetration,
            f"camera_distance_mm must exceed twice max_penetration_mm, {1e3 * self.max_penetration:g}, "
            f"got {1e3 * self.camera_distance:g}",
        )
        half_diagonal = float(np.hypot(*self.half_window))
        need(
            self.membrane_radius == 0 or self.membrane_radius > 1.02 * half_diagonal,
            f"membrane_radius_mm must be 0 (flat) or exceed the window's half diagonal, {1e3 * half_diagonal:.2f} mm, "
            f"got {1e3 * self.membrane_radius:g}",
        )
        need(
            self.housing_depth is None or self.housing_depth >= 0,
            f"housing_depth_mm must be >= 0, got {1e3 * (self.housing_depth or 0):g}",
        )
        need(self.height_noise > 0, f"height_noise_mm must be positive, got {1e3 * self.height_noise:g}")
        need(
            self.height_correlation > 0,
            f"height_correlation_mm must be positive, got {1e3 * self.height_correlation:g}",
        )
        need(
            0 <= self.border_fraction < 0.5,
            f"border_fraction is the share cut off at each side, 0 to 0.49, got {self.border_fraction:g}",
        )
        need(
            self.contact_method in CONTACT_METHODS,
            f"contact_method must be one of {', '.join(CONTACT_METHODS)}, got {self.contact_method!r}"
            f"{did_you_mean(str(self.contact_method), CONTACT_METHODS)}",
        )
        for name in ("camera_rotation_deg", "driver_rotation_deg"):
            need(
                getattr(self, name) in ROTATIONS,
                f"{name} must be 0, 90, 180 or 270, counter-clockwise, got {getattr(self, name)!r}",
            )

    @classmethod
    def load(cls, source: str | Path | Sensor) -> Sensor:
        """A bundled sensor by name, or one from a TOML file, a YAML file of gs_sdk or TACTO, or gsrobotics' JSON file.

        Raises
        ------
        SensorError
            Unknown name (the nearest is named), unreadable file, unknown or missing key, wrong type.
        """
        if isinstance(source, Sensor):
            return source
        text = str(source)
        if text in bundled_sensors():
            return cls.from_toml(_folder().joinpath(f"{text}.toml").read_text("utf-8"), text)
        path = Path(text)
        suffix = path.suffix.lower()
        if suffix in (".toml", *_OTHER_FORMATS) or path.is_file():
            try:
                content = read_text(path)
            except FileNotFoundError:
                raise SensorError(f"sensor file {path}: no such file; give a TOML file or a bundled sensor") from None
            except (OSError, ValueError) as error:
                raise SensorError(f"sensor file {path}: cannot be read ({error}); give a TOML file") from None
            if suffix not in _OTHER_FORMATS:
                return cls.from_toml(content, str(path))
            from geomtact.sensing.foreign_sensor_files import BASE, foreign_values

            base = _folder().joinpath(f"{BASE}.toml").read_text("utf-8")
            return cls._named(str(path), foreign_values(content, str(path), toml_values(base, BASE, fields(cls))))
        raise SensorError(f"no sensor named {text!r}{nearest_name(text, bundled_sensors())}; or give a .toml file")

    @classmethod
    def from_toml(cls, text: str, origin: str = "sensor") -> Sensor:
        """Parse the TOML text of one sensor; ``origin`` names it in errors."""
        return cls._named(origin, toml_values(text, origin, fields(cls)))

    @classmethod
    def _named(cls, origin: str, values: dict[str, Any]) -> Sensor:
        """The sensor of the fields ``values``; errors name ``origin``."""
        try:
            return cls(**values)
        except SensorError as error:
            raise SensorError(f"{origin}: {error}") from None

    def to_toml(self) -> str:
        """The TOML text that :meth:`from_toml` reads back to the same sensor."""
        return toml_text({f.name: getattr(self, f.name) for f in fields(self)}, fields(self))

    @cached_property
    def sha256(self) -> str:
        """Hash of the geometry (not of the note, nor of how its tactile images are read)."""
        geometry = [getattr(self, f.name) for f in fields(self) if f.compare]
        return hashlib.sha256(repr(geometry).encode()).hexdigest()

    @property
    def turned(self) -> bool:
        """Whether images of the camera are turned or mirrored to be the sensor's."""
        return self.camera_mirrored or self.camera_rotation_deg != 0

    @property
    def camera_size_px(self) -> tuple[int, int]:
        """(width, height) of the camera's images, before they are turned by ``camera_rotation_deg``."""
        width, height = self.image_size_px
        return (height, width) if self.camera_rotation_deg in (90, 270) else (width, height)

    def straight_from_camera(self, image: NDArray[Any]) -> bool:
        """Whether the maker's driver has not turned an image (H, W, ...): its width and height are exchanged."""
        width, height = self.camera_size_px
        return self.driver_rotation_deg in (90, 270) and image.shape[:2] == (width, height) and width != height

    def upright(self, image: NDArray[Any]) -> NDArray[Any]:
        """An image (H, W, ...) of the camera, mirrored and turned as the sensor is mounted: one in the sensor frame."""
        image = self._turned_by_driver(image)
        if self.camera_mirrored:
            image = image[:, ::-1]
        return np.ascontiguousarray(np.rot90(image, self.camera_rotation_deg // 90))

    def driven(self, frame: NDArray[Any]) -> NDArray[Any]:
        """A frame (H, W, 3) straight from the camera as the maker's driver gives it: turned, its border cut off, and scaled."""
        image = self._turned_by_driver(frame)
        if not (self.border_fraction and alike_in_aspect(image.shape, self.camera_size_px)):
            return image
        import cv2

        inside = image[self.cut(image.shape)]
        return np.asarray(cv2.resize(inside, self.camera_size_px, interpolation=cv2.INTER_AREA))

    def _turned_by_driver(self, image: NDArray[Any]) -> NDArray[Any]:
        return np.rot90(image, self.driver_rotation_deg // 90) if self.straight_from_camera(image) else image

    @property
    def half_window(self) -> Array:
        """Half width and half height (2,) of the window on the membrane [m]."""
        return 0.5 * np.asarray(self.image_size_px) * np.asarray(self.pixel_pitch)

    @property
    def corners(self) -> Array:
        """Corners (4, 3) of the window, one after the other [m]."""
        x, y = self.half_window
        return np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])

    def pixel_area(self, shape: tuple[int, ...]) -> float:
        """Area [m^2] of a pixel of a grid (h, w) over the window."""
        return float(4 * self.half_window.prod() / np.prod(shape))

    @property
    def tall(self) -> bool:
        """Whether the window is higher than wide."""
        return bool(self.half_window[1] > self.half_window[0])

    def along(self, shape: tuple[int, int]) -> tuple[int, int]:
        """``shape`` = (short, long) of a grid over the window as (h, w): the long side along the window's."""
        return shape[::-1] if self.tall else shape

    def sag(self, x: ArrayLike, y: ArrayLike) -> Array:
        """How far the membrane lies below its apex at (x, y) [m]: z_membrane = -sag."""
        x, y = np.asarray(x, float), np.asarray(y, float)
        if self.membrane_radius == 0:
            return np.zeros(np.broadcast_shapes(x.shape, y.shape))
        r2 = np.minimum(x**2 + y**2, self.membrane_radius**2)
        return r2 / (self.membrane_radius + np.sqrt(self.membrane_radius**2 - r2))

    def pixel_centres(self, shape: tuple[int, int] | None = None) -> tuple[Array, Array]:
        """x (w,) and y (h,) of pixel centres at z = 0 [m], for the image or for a grid ``shape`` = (h, w) over it."""
        half = self.half_window
        w, h = self.image_size_px if shape is None else shape[::-1]
        x = ((np.arange(w) + 0.5) / w * 2 - 1) * half[0]
        y = ((np.arange(h) + 0.5) / h * 2 - 1) * half[1]
        return x, y

    def cut(self, shape: tuple[int, ...]) -> tuple[slice, slice]:
        """Rows and columns of a camera's frame (h, w, ...) that its images show, before they are scaled."""
        rows, columns = (int(round(n * self.border_fraction, 2)) for n in shape[:2])
        return slice(rows, shape[0] - rows), slice(columns, shape[1] - columns)

    def project(self, points: ArrayLike) -> Array:
        """Where the camera rays through ``points`` (..., 3) [m] cross z = 0: (..., 2) [m]."""
        p = np.asarray(points, float)
        if self.camera_distance == 0:
            return p[..., :2].copy()
        return p[..., :2] * (self.camera_distance / np.maximum(self.camera_distance + p[..., 2:], 1e-9))

    def lift(self, xy: ArrayLike, depth: ArrayLike = 0.0) -> Array:
        """The points (..., 3) [m] of the gel seen through ``xy`` (..., 2) at z = 0: where each camera ray meets the membrane, or
        what lies ``depth`` (...) [m] below it."""
        xy, depth = np.asarray(xy, float), np.asarray(depth, float)
        x, y = xy[..., 0], xy[..., 1]
        below, shrink = self.sag(x, y) + depth, np.ones(np.broadcast_shapes(x.shape, depth.shape))
        for _ in range(20 if self.camera_distance and self.membrane_radius else bool(self.camera_distance)):
            shrink = 1 - below / self.camera_distance
            below = self.sag(x * shrink, y * shrink) + depth
        return np.stack([x * shrink, y * shrink, np.broadcast_to(-below, shrink.shape)], -1)

    def to_pixels(self, xy: ArrayLike) -> Array:
        """Continuous pixel coordinates (column, row) (..., 2) of ``xy`` (..., 2) [m] at z = 0; pixel centres are whole."""
        return (np.asarray(xy, float) + self.half_window) / np.asarray(self.pixel_pitch) - 0.5

    def from_pixels(self, uv: ArrayLike) -> Array:
        """Inverse of :meth:`to_pixels`."""
        return (np.asarray(uv, float) + 0.5) * np.asarray(self.pixel_pitch) - self.half_window


def alike_in_aspect(shape: tuple[int, ...], size: tuple[int, int]) -> bool:
    """Whether an image (h, w, ...) is about as wide for its height as one of ``size`` (width, height)."""
    return abs(shape[1] * size[1] / (shape[0] * size[0]) - 1) < _ALIKE


def bundled_sensors() -> list[str]:
    """Names of the sensors that come with geomtact."""
    return sorted(p.name.removesuffix(".toml") for p in _folder().iterdir() if p.name.endswith(".toml"))


def _folder():
    return resources.files("geomtact") / "sensing" / "sensors"
