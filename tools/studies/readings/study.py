"""Real tactile images judged: contacts against circles drawn by hand, a calibration by the ball it did not see, and
balls localized.

Hand-drawn circles mark the imprint, which is wider than the contact: one factor for each set of images and method is fitted on
every other image and judged on the rest.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.errors import InputError
from geomtact.geometry.mesh import Mesh
from geomtact.localizer import Localizer
from geomtact.se3 import Array
from geomtact.sensing.calibrate import SensorCalibration, calibrate_sensor, measured_diameter
from geomtact.sensing.image_file import read_image
from geomtact.sensing.local_shape import contact_mask
from geomtact.sensing.sensor import CONTACT_METHODS, Sensor
from tools.studies.common.study import mean_with_interval

MM = 1e-3
BALLS = (6.310, 9.500)  # mm, of the folder gelslam_gsmini_balls
_FACTORS = np.arange(0.5, 2.005, 0.02)  # of imprint over contact, in diameter
_RESAMPLED = 2000
_BY_EYE = ("file", "inside", "cx_px", "cy_px", "r_px")  # columns of circles drawn by eye

Mask = NDArray[np.bool_]
Method = Callable[[Any, Any], Mask]


@dataclass(frozen=True, eq=False)
class Imprint:
    """A tactile image on which the ball's imprint was drawn by hand.

    Attributes
    ----------
    image, background : (H, W, 3) uint8
    circle : (column, row, radius) [px]
    """

    name: str
    image: NDArray[np.uint8]
    background: NDArray[np.uint8]
    circle: tuple[float, float, float]


@dataclass(frozen=True)
class Found:
    """What a method makes of one imprint.

    Attributes
    ----------
    factor : imprint over contact, in diameter, as fitted on the other half of the images
    iou : overlap with the circle made smaller by it
    centre : how far the contact's centroid is off the circle's centre, in shares of the image's width
    ms : that it took
    """

    name: str
    method: str
    factor: float
    iou: float
    centre: float
    ms: float


@dataclass(frozen=True)
class Pressed:
    """One ball press localized by heights, the sensor calibrated with presses of the other ball.

    Attributes
    ----------
    inside : whether the whole contact is in the window
    nats : log evidence of the ball that was pressed, less that of the other
    off_mm : of the first mode's centre from that of the circle drawn by eye
    deep_mm : how far the first mode presses the gel in
    """

    name: str
    ball_mm: float
    inside: bool
    nats: float
    off_mm: float
    deep_mm: float


def imprints(folder: Path) -> dict[str, list[Imprint]]:
    """The imprints of the data folder, by set.

    Raises
    ------
    InputError
        The folder does not hold them.
    """
    fots, pack = folder / "fots_balls", folder / "objectfolder_gelsight_calib" / "dataPack_subset.npz"
    wanted = "fots_balls and objectfolder_gelsight_calib"
    if not (fots.is_dir() and pack.is_file()):
        raise InputError(f"{folder}: expected {wanted} in it; give that of the images (docs/evaluation-real-images.md)")
    try:
        rows = circles_of(fots / "gelsight_contact_circles.csv")
        columns = ("image", "center_x_px", "center_y_px", "radius_px")
        soft = _drawn(rows, columns, fots / "gelsight", fots / "gelsight_bg.png")
        with np.load(pack, allow_pickle=False) as data:
            drawn = zip(data["imgs"], data["touch_center"], data["touch_radius"], strict=True)
            hard = [
                Imprint(f"{i}", image, data["f0"], (float(at[0]), float(at[1]), float(r)))
                for i, (image, at, r) in enumerate(drawn)
            ]
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{folder}: expected {wanted} as their makers wrote them ({error})") from None
    return {"fots": soft, "objectfolder": hard}


def imprints_by_eye(folder: Path, circles: Path) -> list[Imprint]:
    """The GelSight Mini presses that lie wholly in the window, with the circles drawn by eye that the file ``circles`` holds.

    Raises
    ------
    InputError
        A tactile image is missing, or the file has not the columns of the one in ``tests``.
    """
    rows = [row for row in circles_of(circles, _BY_EYE) if row["inside"] == "1"]
    presses = _presses(folder)
    return _drawn(rows, ("file", "cx_px", "cy_px", "r_px"), presses, presses / "background.png")


def _drawn(rows: Sequence[Mapping[str, str]], columns: Sequence[str], folder: Path, background: Path) -> list[Imprint]:
    """The tactile images of ``folder`` that ``rows`` name, with the circles drawn on them; ``columns`` are those of
    the name and of the circle's column, row and radius."""
    empty = read_image(background)[..., :3]
    out = []
    for row in rows:
        name, *circle = (row[column] for column in columns)
        u, v, radius = map(float, circle)
        out.append(Imprint(name, read_image(folder / name)[..., :3], empty, (u, v, radius)))
    return out


def methods() -> dict[str, Method]:
    """From a tactile image and its background to the contact: ours, and the classical baseline."""
    ours: dict[str, Method] = {name: partial(contact_mask, method=name) for name in CONTACT_METHODS}
    return ours | {"difference": largest_difference}


def largest_difference(image: Any, background: Any) -> Mask:
    """The baseline: the largest component of what differs from the background by more than Otsu's threshold."""
    from scipy import ndimage
    from skimage.filters import threshold_otsu

    difference = np.abs(np.asarray(image, float) - np.asarray(background, float)).sum(-1)
    labels, n = ndimage.label(difference > threshold_otsu(difference))
    sizes = ndimage.sum_labels(np.ones_like(labels), labels, range(1, n + 1))
    return np.asarray(labels == 1 + int(np.argmax(sizes)))


def find(imprints: Sequence[Imprint], name: str, method: Method) -> list[Found]:
    """What ``method`` makes of imprints, each judged with the factor that suits the other half of them best."""
    masks, times = [], []
    for imprint in imprints:
        began = time.perf_counter()
        masks.append(method(imprint.image, imprint.background))
        times.append(1e3 * (time.perf_counter() - began))
    ious = np.array([overlap(mask, i.circle, _FACTORS) for mask, i in zip(masks, imprints, strict=True)])
    suits = [int(np.median(ious[1 - half :: 2], 0).argmax()) for half in (0, 1)]
    out = []
    for k, (mask, imprint) in enumerate(zip(masks, imprints, strict=True)):
        best = suits[k % 2]
        off = off_centre(mask, imprint.circle)
        out.append(Found(imprint.name, name, float(_FACTORS[best]), float(ious[k, best]), off, times[k]))
    return out


def overlap(mask: Mask, circle: Sequence[float], factors: ArrayLike) -> Array:
    """Intersection over union (...,) of ``mask`` (H, W) with a ``circle`` made smaller by each of the ``factors`` (...,)."""
    v, u = np.indices(mask.shape)
    far, radii = np.hypot(u - circle[0], v - circle[1]), circle[2] / np.asarray(factors, float)
    within, both = (np.searchsorted(np.sort(some.ravel()), radii, side="right") for some in (far, far[mask]))
    return np.asarray(both / np.maximum(mask.sum() + within - both, 1))


def off_centre(mask: Mask, circle: Sequence[float]) -> float:
    """Distance of the centroid of ``mask`` (H, W) from the ``circle``'s centre, in widths of the image; inf without contact."""
    if not mask.any():
        return np.inf
    at = np.argwhere(mask).mean(0)[::-1]
    return float(np.hypot(*(at - circle[:2])) / mask.shape[1])


def summarise_contacts(found: Sequence[Found]) -> dict[str, Any]:
    """Of one set and method: the factors, the median overlap with its 95 % bootstrap interval, and the median distance of
    centres."""
    iou = np.array([f.iou for f in found])
    rng = np.random.default_rng(0)
    medians = np.median(rng.choice(iou, (_RESAMPLED, len(iou))), 1)
    return {
        "n": len(found),
        "factors": sorted({f.factor for f in found}),
        "iou_median": float(np.median(iou)),
        "iou_interval": [float(q) for q in np.quantile(medians, (0.025, 0.975))],
        "iou_least": float(iou.min()),
        "centre_median": float(np.median([f.centre for f in found])),
        "ms_median": float(np.median([f.ms for f in found])),
    }


def cameras() -> dict[str, Sensor]:
    """The GelSight Mini as the makers of the presses publish it, with a pitch and no more, and as its file has it: the camera's
    distance there is nominal."""
    stated = Sensor.load("gelsight-mini")
    return {
        "parallel rays": replace(stated, camera_distance=0.0),
        f"camera at {stated.camera_distance / MM:g} mm": stated,
    }


def calibrations(folder: Path, sensor: Sensor) -> dict[float, SensorCalibration]:
    """``sensor`` calibrated with the presses of each ball [mm]."""
    presses = _presses(folder)
    return {
        ball: calibrate_sensor(
            sorted((presses / f"{ball:.3f}mm").glob("*.png")), ball * MM, presses / "background.png", sensor=sensor
        )
        for ball in BALLS
    }


def measure_balls(found: Mapping[float, SensorCalibration]) -> list[dict[str, float]]:
    """Each ball's diameter [mm] by its own calibration and by the other's: median, and share by which it is off."""
    out = []
    sensors = {ball: each.sensor for ball, each in found.items()}
    for ball in BALLS:
        presses = found[ball].presses
        for used, sensor in sensors.items():
            told = float(np.nanmedian([measured_diameter(press, sensor) for press in presses])) / MM
            out.append({"used_mm": used, "ball_mm": ball, "told_mm": told, "off": told / ball - 1})
    return out


def localize_balls(
    folder: Path, circles: Path, sensors: Mapping[float, Sensor], cache_dir: Any = None, first: int = 0
) -> Iterator[Pressed]:
    """Every press localized as either ball, from ``first`` on, with the calibration that saw presses of the other ball alone."""
    background = _presses(folder) / "background.png"
    balls = {}
    for ball in BALLS:
        prepared = Localizer.prepare(_ball(ball), sensor=list(sensors.values()), cache_dir=cache_dir)
        each = [replace(one, others=()) for one in prepared.by_sensor]
        for used, localizer in zip(sensors, each, strict=True):
            balls[ball, used] = localizer
    for row in circles_of(circles, (*_BY_EYE, "ball_mm"))[first:]:
        pressed = float(row["ball_mm"])
        (other,) = (ball for ball in BALLS if ball != pressed)
        told = {
            ball: balls[ball, other].localize(_presses(folder) / row["file"], "reading", background) for ball in BALLS
        }
        centre = told[pressed].modes(1)[0].T[:3, 3]
        seen = sensors[other].from_pixels([float(row["cx_px"]), float(row["cy_px"])])
        yield Pressed(
            name=row["file"],
            ball_mm=pressed,
            inside=row["inside"] == "1",
            nats=told[pressed].log_evidence - told[other].log_evidence,
            off_mm=float(np.linalg.norm(centre[:2] - seen)) / MM,
            deep_mm=0.5 * pressed - float(centre[2]) / MM,
        )


def summarise_balls(pressed: Sequence[Pressed]) -> list[dict[str, Any]]:
    """For each ball: the share whose own evidence is larger, by how many nats, and how far centres are off where the contact
    is whole."""
    rng, out = np.random.default_rng(0), []
    for ball in sorted({p.ball_mm for p in pressed}):
        some = [p for p in pressed if p.ball_mm == ball]
        whole = np.array([p.off_mm for p in some if p.inside])
        out.append(
            {
                "ball_mm": ball,
                "n": len(some),
                "right": float(np.mean([p.nats > 0 for p in some])),
                "nats": mean_with_interval(np.array([p.nats for p in some]), rng),
                "whole": len(whole),
                "off_mm_median": float(np.median(whole)),
                "within_0.3_mm": float((whole <= 0.3).mean()),
                "off_mm_largest": float(whole.max()),
            }
        )
    return out


def _presses(folder: Path) -> Path:
    return folder / "gelslam_gsmini_balls"


def _ball(diameter_mm: float) -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5 * diameter_mm * MM)
    return Mesh(ball.vertices, ball.faces, f"ball of {diameter_mm:.3f} mm", "m")


def circles_of(path: Path, columns: Sequence[str] = ()) -> list[dict[str, str]]:
    """The rows of a CSV of circles, comments left out.

    Raises
    ------
    InputError
        It has not all of the ``columns``.
    """
    lines = [line for line in path.read_text("utf-8").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    missing = set(columns) - set(rows[0] if rows else ())
    if missing:
        raise InputError(f"{path}: expected a table of circles with the columns {', '.join(sorted(missing))}; add them")
    return rows
