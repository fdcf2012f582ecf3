"""The sensor: a camera behind a gel membrane, described by a TOML file.

The frame is the one of docs/conventions.md: origin at the image centre on the undeformed membrane, +x along
image columns, +y along rows, +z out towards the object. The camera sits at (0, 0, -camera_distance).
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from dataclasses import dataclass, field, fields
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomtact.errors import SensorError, nearest_name
from geomtact.se3 import Array
from geomtact.sensing.colour import ColourTable

_KEYS = {
    "name": str,
    "image_size_px": list,
    "pixel_pitch_mm": list,
    "camera_distance_mm": float,
    "max_penetration_mm": float,
    "membrane_radius_mm": float,
    "housing_depth_mm": float,
    "height_noise_mm": float,
    "contact_method": str,
    "note": str,
    "colour": dict,
}
_COLOUR_KEYS = ("weights", "slope_rms", "height_rms_mm", "contact_depth_mm")
_REQUIRED = ("name", "image_size_px", "pixel_pitch_mm", "camera_distance_mm", "max_penetration_mm")
_YAML = (".yaml", ".yml")

HEIGHT_NOISE = 0.1e-3  # m, of a sensor that says nothing of it
CONTACT_METHODS = ("auto", "classical", "pressure", "learned")  # of finding the contact in a reading, the default first


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
    height_noise : standard deviation of its heights, beside a twentieth of each
    contact_method : one of ``CONTACT_METHODS``, which finds the contact in its readings
    note : where the figures come from
    colour : how its colours tell the gel's slope; None where that is not calibrated
    """

    name: str
    image_size_px: tuple[int, int]
    pixel_pitch: tuple[float, float]
    camera_distance: float
    max_penetration: float
    membrane_radius: float = 0.0
    housing_depth: float | None = None
    height_noise: float = field(default=HEIGHT_NOISE, compare=False)
    contact_method: str = field(default=CONTACT_METHODS[0], compare=False)
    note: str = field(default="", compare=False)
    colour: ColourTable | None = field(default=None, compare=False)

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
            self.contact_method in CONTACT_METHODS,
            f"contact_method must be one of {', '.join(CONTACT_METHODS)}, got {self.contact_method!r}",
        )

    @classmethod
    def load(cls, source: str | Path | Sensor) -> Sensor:
        """A bundled sensor by name, or one from a TOML file, or from a YAML file of gs_sdk or TACTO.

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
        if path.suffix in (".toml", *_YAML) or path.is_file():
            try:
                said = path.read_text("utf-8-sig")
            except FileNotFoundError:
                raise SensorError(f"sensor file {path}: no such file; give a TOML file or a bundled sensor") from None
            except (OSError, UnicodeDecodeError) as error:
                raise SensorError(f"sensor file {path}: cannot be read ({error}); give a TOML file") from None
            if path.suffix not in _YAML:
                return cls.from_toml(said, str(path))
            from geomtact.sensing.others import sensor_of_yaml

            return sensor_of_yaml(said, str(path))
        raise SensorError(f"no sensor named {text!r}{nearest_name(text, bundled_sensors())}; or give a .toml file")

    @classmethod
    def from_toml(cls, text: str, origin: str = "sensor") -> Sensor:
        """Parse the TOML text of one sensor; ``origin`` names it in errors."""
        try:
            data = tomllib.loads(text)
        except RecursionError:
            raise SensorError(
                f"{origin}: lists within lists within lists; write plain ones, see 'geomtact sensors'"
            ) from None
        except tomllib.TOMLDecodeError as error:
            raise SensorError(
                f"{origin}: not valid TOML ({error}); write lines such as name = \"mine\", see 'geomtact sensors'"
            ) from None
        for key in data:
            if key not in _KEYS:
                raise SensorError(f"{origin}: unknown key {key!r}{nearest_name(key, _KEYS)}")
        missing = [repr(key) for key in _REQUIRED if key not in data]
        if missing:
            which = f"the key {missing[0]} is" if len(missing) == 1 else f"the keys {', '.join(missing)} are"
            raise SensorError(f"{origin}: {which} missing; add what docs/formats.md says of a sensor's file")
        for key, value in data.items():
            wanted = _KEYS[key]
            number = _number(value)
            if (wanted is float and not number) or (wanted is str and not isinstance(value, str)):
                raise SensorError(f"{origin}: {key} must be a {wanted.__name__}, got {value!r}")
            if wanted is dict and not isinstance(value, dict):
                raise SensorError(f"{origin}: {key} must be a table, got {value!r}; write [{key}]")
            if wanted is list and not (isinstance(value, list) and len(value) == 2 and all(_number(v) for v in value)):
                raise SensorError(f"{origin}: {key} must be two numbers (along x, along y), got {value!r}")
        if any(v != int(v) for v in data["image_size_px"]):
            raise SensorError(f"{origin}: image_size_px must be whole numbers, got {data['image_size_px']}")
        if max(data["pixel_pitch_mm"]) > 10:
            raise SensorError(
                f"{origin}: pixel_pitch_mm {data['pixel_pitch_mm']} is over a centimetre; give millimetres a pixel"
            )
        housing = data.get("housing_depth_mm")
        width, height = data["image_size_px"]
        pitch_x, pitch_y = data["pixel_pitch_mm"]
        try:
            return cls(
                name=data["name"],
                image_size_px=(int(width), int(height)),
                pixel_pitch=(pitch_x / 1e3, pitch_y / 1e3),
                camera_distance=data["camera_distance_mm"] / 1e3,
                max_penetration=data["max_penetration_mm"] / 1e3,
                membrane_radius=data.get("membrane_radius_mm", 0.0) / 1e3,
                housing_depth=None if housing is None else housing / 1e3,
                height_noise=data.get("height_noise_mm", 1e3 * HEIGHT_NOISE) / 1e3,
                contact_method=data.get("contact_method", CONTACT_METHODS[0]),
                note=data.get("note", ""),
                colour=_colour(data["colour"]) if "colour" in data else None,
            )
        except SensorError as error:
            raise SensorError(f"{origin}: {error}") from None

    def to_toml(self) -> str:
        """The TOML text that :meth:`from_toml` reads back to the same sensor."""

        def mm(metres: float) -> str:
            return repr(float(f"{metres * 1e3:.12g}"))

        lines = [
            f"name = {_toml_string(self.name)}",
            f"image_size_px = [{self.image_size_px[0]}, {self.image_size_px[1]}]",
            f"pixel_pitch_mm = [{mm(self.pixel_pitch[0])}, {mm(self.pixel_pitch[1])}]",
            f"camera_distance_mm = {mm(self.camera_distance)}",
            f"max_penetration_mm = {mm(self.max_penetration)}",
            f"membrane_radius_mm = {mm(self.membrane_radius)}",
        ]
        if self.housing_depth is not None:
            lines.append(f"housing_depth_mm = {mm(self.housing_depth)}")
        if self.height_noise != HEIGHT_NOISE:
            lines.append(f"height_noise_mm = {mm(self.height_noise)}")
        if self.contact_method != CONTACT_METHODS[0]:
            lines.append(f"contact_method = {_toml_string(self.contact_method)}")
        if self.note:
            lines.append(f"note = {_toml_string(self.note)}")
        if self.colour is not None:
            lines += ["", "[colour]", f"slope_rms = {self.colour.slope_rms:.6g}"]
            lines += [
                f"height_rms_mm = {mm(self.colour.height_rms)}",
                f"contact_depth_mm = {mm(self.colour.contact_depth)}",
            ]
            rows = ("  [" + ", ".join(f"{w:.9g}" for w in row) + "]," for row in self.colour.weights)
            lines += ["weights = [", *rows, "]"]
        return "\n".join(lines) + "\n"

    @cached_property
    def sha256(self) -> str:
        """Hash of the geometry (not of the note, nor of how its readings are read)."""
        geometry = [getattr(self, f.name) for f in fields(self) if f.compare]
        return hashlib.sha256(repr(geometry).encode()).hexdigest()

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


def bundled_sensors() -> list[str]:
    """Names of the sensors that come with geomtact."""
    return sorted(p.name.removesuffix(".toml") for p in _folder().iterdir() if p.name.endswith(".toml"))


def _folder():
    return resources.files("geomtact") / "sensing" / "sensors"


def _number(value: Any) -> bool:
    """Whether it is a number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return bool(abs(value) < 1e300)


def _colour(data: dict[str, Any]) -> ColourTable:
    """The table of a sensor file's [colour]."""
    for key in data:
        if key not in _COLOUR_KEYS:
            raise SensorError(f"unknown key {key!r} in [colour]{nearest_name(key, _COLOUR_KEYS)}")
    for key in _COLOUR_KEYS:
        if key not in data:
            raise SensorError(f"the key {key!r} is missing in [colour]; calibrate the sensor again")
    numbers = [data[key] for key in _COLOUR_KEYS[1:]]
    rows = data["weights"] if isinstance(data["weights"], list) else []
    lists = len(rows) == 2 and all(isinstance(row, list) for row in rows)
    if not lists or not all(_number(v) for v in (*numbers, *rows[0], *rows[1])):
        raise SensorError("[colour] must hold numbers, and weights two lists of them; calibrate the sensor again")
    x, y = (tuple(map(float, row)) for row in rows)
    slope, height, depth = map(float, numbers)
    return ColourTable((x, y), slope, 1e-3 * height, 1e-3 * depth)


def _toml_string(text: str) -> str:
    # a string of JSON is one of TOML, but that TOML wants DEL escaped too
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
