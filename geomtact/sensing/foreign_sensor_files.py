"""Sensor files of other makers: what gs_sdk, TACTO and gsrobotics write of a sensor's geometry, read as a sensor's fields.

None says how deep a gel may be pressed in, and gs_sdk nothing of the camera's distance: then 2 mm, and parallel rays. gsrobotics'
file says no more than which part of a GelSight Mini's frame its images show.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from geomtact.errors import SensorError

BASE = "gelsight-mini"  # the bundled sensor that a file of gsrobotics completes
Values = dict[str, Any]
_DEPTH = 2e-3  # m that an object can press in
_TACTO_SIZE = (240, 320)  # px; the file does not say
_GSROBOTICS = ("camera_width", "camera_height", "border_fraction")
_MOST_CUT = 0.49  # to which gsrobotics limits its border_fraction
_KINDS = (
    "one of gs_sdk with ppmm, imgw and imgh, or one of TACTO with sensor: camera and gel, or one of gsrobotics with "
    "camera_width, camera_height and border_fraction"
)


def foreign_values(text: str, origin: str, base: Values) -> Values:
    """The fields of the sensor in the YAML file of gs_sdk or TACTO, or the JSON file of gsrobotics, named ``origin``.

    ``ppmm`` of gs_sdk is millimetres per pixel. TACTO's gel, if curved, is read as a sphere that falls by ``curvatureMax`` to
    the gel's corners, seen from the camera's ``position`` with ``yfov``; its picture has 240 x 320 px. gsrobotics' sensor is a
    GelSight Mini, whose fields are ``base``, and ``border_fraction`` of its frame is cut off at each side.

    Raises
    ------
    SensorError
        It is no such file, or says what cannot be.
    """
    import yaml

    form = "JSON" if Path(origin).suffix.lower() == ".json" else "YAML"
    try:
        data = json.loads(text) if form == "JSON" else yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError, KeyError, AttributeError, IndexError, TypeError) as error:
        raise SensorError(f"{origin}: not valid {form} ({' '.join(str(error).split())}); expected {_KINDS}") from None
    name = Path(origin).stem
    try:
        if isinstance(data, dict) and "ppmm" in data:
            return _of_gs_sdk(data, name)
        if isinstance(data, dict) and isinstance(data.get("sensor"), dict):
            return _of_tacto(data["sensor"], name)
        if isinstance(data, dict) and any(key in data for key in _GSROBOTICS):
            return _of_gsrobotics(data, name, base)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise SensorError(f"{origin}: expected {_KINDS}; what this one holds is not valid ({error})") from None
    except SensorError as error:
        raise SensorError(f"{origin}: {error}") from None
    raise SensorError(f"{origin}: expected {_KINDS}; or write a TOML file, see 'geomtact sensors'")


def _of_gs_sdk(data: Mapping[str, Any], name: str) -> Values:
    pitch = 1e-3 * _number(data["ppmm"])
    if pitch > 1e-3:
        raise SensorError(f"ppmm is millimetres per pixel in gs_sdk, and {data['ppmm']} are too many; give 1 over it")
    if type(data["imgw"]) is not int or type(data["imgh"]) is not int:
        raise SensorError(f"imgw and imgh must be whole numbers, got {data['imgw']} and {data['imgh']}")
    named = data.get("device_name")
    return {
        "name": named if isinstance(named, str) and named else name,
        "image_size_px": (data["imgw"], data["imgh"]),
        "pixel_pitch": (pitch, pitch),
        "camera_distance": 0.0,
        "max_penetration": _DEPTH,
        "note": f"From gs_sdk's file {name}, which says nothing of the camera's distance, the gel's curvature and its depth.",
    }


def _of_tacto(data: Mapping[str, Any], name: str) -> Values:
    camera, gel = data["camera"], data["gel"]
    if gel.get("mesh") or (isinstance(camera, list) and len(camera) != 1):
        raise SensorError("expected one camera before a flat or spherical gel; write a TOML file for others")
    camera = camera[0] if isinstance(camera, list) else camera
    distance = _number(gel["origin"][0]) - _number(camera["position"][0])  # it looks along x
    if not distance > 0:
        raise SensorError(f"expected the gel before the camera, along x, got {distance:g} m; write a TOML file")
    width, height = _TACTO_SIZE
    view = _number(camera["yfov"])
    if not np.pi < view < 180:  # up to pi it may be in radians
        raise SensorError(
            f"yfov is in degrees in TACTO, 3.2 to 180, got {view:g}; of radians give {np.degrees(view):.4g}"
        )
    pitch = 2 * distance * float(np.tan(np.radians(view) / 2)) / height
    fall = _number(gel.get("curvatureMax", 0)) if gel.get("curvature") else 0.0
    corner2 = (_number(gel["width"]) ** 2 + _number(gel["height"]) ** 2) / 4
    return {
        "name": name,
        "image_size_px": (width, height),
        "pixel_pitch": (pitch, pitch),
        "camera_distance": distance,
        "max_penetration": _DEPTH,
        "membrane_radius": (corner2 + fall**2) / (2 * fall) if fall > 0 else 0.0,
        "note": f"From TACTO's file {name}, which says nothing of the gel's depth: 2 mm. The picture is taken as 240 x 320 px.",
    }


def _number(value: Any) -> float:
    """A number of a YAML file, which takes 1e-3 for a text; ValueError of a truth value, as yes is there."""
    if isinstance(value, bool):
        raise ValueError(f"expected a number, got {value}")
    return float(value)


def _of_gsrobotics(data: Mapping[str, Any], name: str, base: Values) -> Values:
    for key in _GSROBOTICS:
        if key not in data:
            raise SensorError(f"the key {key!r} is missing; gsrobotics writes {', '.join(_GSROBOTICS)}")
    width, height, border = (data[key] for key in _GSROBOTICS)
    if type(width) is not int or type(height) is not int or min(width, height) < 1:
        raise SensorError(f"camera_width and camera_height must be whole numbers > 0, got {width!r} and {height!r}")
    if isinstance(border, bool) or not 0 <= border <= _MOST_CUT:
        raise SensorError(f"border_fraction is the share cut off at each side, 0 to {_MOST_CUT}, got {border!r}")
    window = np.asarray(base["image_size_px"]) * np.asarray(base["pixel_pitch"])
    frame = window / (1 - 2 * base.get("border_fraction", 0.0))  # of the camera, on the membrane [m]
    x, y = (float(f"{pitch:.6g}") for pitch in frame * (1 - 2 * border) / (width, height))
    return base | {
        "name": name,
        "image_size_px": (width, height),
        "pixel_pitch": (x, y),
        "border_fraction": float(border),
        "note": f"From gsrobotics' file {name}: a GelSight Mini, of whose frame {100 * border:g} % are cut off at each side. All "
        "else is gelsight-mini's, the frame's size on the membrane too.",
    }
