"""The TOML file of a sensor: a key for each field, lengths in millimetres."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, Field
from typing import Any

from geomtact.errors import SensorError, nearest_name
from geomtact.json_values import is_number
from geomtact.sensing.colour import ColourTable

_LENGTHS = (
    "pixel_pitch",
    "camera_distance",
    "max_penetration",
    "membrane_radius",
    "housing_depth",
    "height_noise",
    "height_correlation",
)
_PAIRS, _TEXTS = ("image_size_px", "pixel_pitch"), ("name", "contact_method", "note")
_ALWAYS = "membrane_radius"  # is written even where it is the default
_SWITCHES, _WHOLE = ("camera_mirrored", "camera_masks"), ("camera_rotation_deg", "driver_rotation_deg")
_COLOUR_KEYS = ("weights", "slope_rms", "height_rms_mm", "contact_depth_mm")
_BACKGROUND = "background"  # in [colour], which files of before do not hold


Fields = tuple[Field[Any], ...]


def toml_values(text: str, origin: str, fields: Fields) -> dict[str, Any]:
    """The values of a sensor's ``fields`` that the TOML ``text`` gives, lengths in metres; ``origin`` names it in errors.

    Raises
    ------
    SensorError
        It is not valid TOML, a key is unknown or missing, or a value has the wrong type.
    """
    keys = _keys(fields)
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
        if key not in keys:
            raise SensorError(f"{origin}: unknown key {key!r}{nearest_name(key, keys)}")
    missing = [repr(key) for key, f in keys.items() if f.default is MISSING and key not in data]
    if missing:
        which = f"the key {missing[0]} is" if len(missing) == 1 else f"the keys {', '.join(missing)} are"
        raise SensorError(f"{origin}: {which} missing; add what docs/formats.md lists for a sensor's file")
    try:
        return {keys[key].name: _value(key, keys[key].name, value) for key, value in data.items()}
    except SensorError as error:
        raise SensorError(f"{origin}: {error}") from None


def toml_text(sensor: Mapping[str, Any], fields: Fields) -> str:
    """The TOML text of a sensor's ``fields`` by name; all but the required ones only where they are not the default."""
    lines = []
    for key, f in _keys(fields).items():
        value = sensor[f.name]
        if f.name == "colour" or (f.name != _ALWAYS and (value is None or value == f.default)):
            continue
        values = value if f.name in _PAIRS else [value]
        if f.name in _LENGTHS:
            values = [_mm(v) for v in values]
        text = ", ".join(_toml_string(v) if f.name in _TEXTS else str(v).lower() for v in values)
        lines.append(f"{key} = [{text}]" if f.name in _PAIRS else f"{key} = {text}")
    colour = sensor["colour"]
    if colour is not None:
        lines += [
            "",
            "[colour]",
            f"slope_rms = {colour.slope_rms:.6g}",
            f"height_rms_mm = {_mm(colour.height_rms)}",
            f"contact_depth_mm = {_mm(colour.contact_depth)}",
        ]
        rows = ("  [" + ", ".join(f"{w:.9g}" for w in row) + "]," for row in colour.weights)
        lines += ["weights = [", *rows, "]"]
        if colour.background is not None:
            rows = ("  [" + ", ".join(f"{v:.3g}" for v in row) + "]," for row in colour.background)
            lines += [f"{_BACKGROUND} = [", *rows, "]"]
    return "\n".join(lines) + "\n"


def _keys(fields: Fields) -> dict[str, Field[Any]]:
    return {f"{f.name}_mm" if f.name in _LENGTHS else f.name: f for f in fields}


def _value(key: str, name: str, value: Any) -> Any:
    """The value of the field ``name``, whose key is ``key``, in metres."""
    if name == "colour":
        if not isinstance(value, dict):
            raise SensorError(f"{key} must be a table, got {value!r}; write [{key}]")
        return _colour(value)
    if name in _TEXTS:
        if not isinstance(value, str):
            raise SensorError(f'{key} must be text, such as {key} = "mine", got {value!r}')
        return value
    if name in _PAIRS:
        if not (isinstance(value, list) and len(value) == 2 and all(is_number(v) for v in value)):
            raise SensorError(f"{key} must be two numbers (along x, along y), got {value!r}")
        if name == "pixel_pitch" and max(value) > 10:
            raise SensorError(f"{key} {value} is over a centimetre; give millimetres a pixel")
        if name == "image_size_px":
            if any(v != int(v) for v in value):
                raise SensorError(f"{key} must be whole numbers, got {value}")
            return int(value[0]), int(value[1])
        return value[0] / 1e3, value[1] / 1e3
    if name in _SWITCHES:
        if not isinstance(value, bool):
            raise SensorError(f"{key} must be true or false, got {value!r}")
        return value
    if not is_number(value):
        raise SensorError(f"{key} must be a number, such as 20.0, got {value!r}")
    if name in _WHOLE:
        return int(value) if value == int(value) else value
    return value / 1e3 if name in _LENGTHS else value


def _colour(data: dict[str, Any]) -> ColourTable:
    """The table of a sensor file's [colour]."""
    for key in data:
        if key not in (*_COLOUR_KEYS, _BACKGROUND):
            raise SensorError(f"unknown key {key!r} in [colour]{nearest_name(key, (*_COLOUR_KEYS, _BACKGROUND))}")
    for key in _COLOUR_KEYS:
        if key not in data:
            raise SensorError(f"the key {key!r} is missing in [colour]; calibrate the sensor again")
    numbers = [data[key] for key in _COLOUR_KEYS[1:]]
    rows = _rows(data["weights"])
    background = _rows(data.get(_BACKGROUND, []))
    if rows is None or len(rows) != 2 or background is None or not all(map(is_number, numbers)):
        raise SensorError(
            "[colour] must hold numbers, weights two lists of them, and background lists of them; calibrate the sensor again"
        )
    slope, height, depth = map(float, numbers)
    return ColourTable((rows[0], rows[1]), slope, 1e-3 * height, 1e-3 * depth, background or None)


def _rows(value: Any) -> tuple[tuple[float, ...], ...] | None:
    """Lists of numbers; None where it is no such thing."""
    if not isinstance(value, list) or not all(isinstance(row, list) and all(map(is_number, row)) for row in value):
        return None
    return tuple(tuple(map(float, row)) for row in value)


def _mm(metres: float) -> float:
    return float(f"{metres * 1e3:.12g}")


def _toml_string(text: str) -> str:
    # a string of JSON is one of TOML, but that TOML wants DEL escaped too
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
