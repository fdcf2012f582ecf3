"""Fit the membrane of the bundled sensor ``digit-hsp`` to the simulated DIGIT touches of hsp_digit_sim_ycb.

    python tools/fit_membrane.py FOLDER_OF_THE_DATA

A camera at the known pose sees the object; a pixel is in contact where the object is nearer than the membrane, and only
there the image differs from the background. The camera's distance and the membrane's radius are those whose outline the
change falls across most steeply. Triplets 1 and 2 of each object are fitted; 3 and 4 are judged, without the touches
that repeat a fitted pose.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from geomtact.se3 import Array, inverse, transform
from geomtact.sensing.cast import Caster
from geomtact.sensing.image_file import read_image
from geomtact.sensing.sensor import Sensor

IMAGE_SIZE_PX = (240, 320)
FOCAL_PX = 0.5 * IMAGE_SIZE_PX[1] / np.tan(np.radians(0.5 * 60))  # vertical field of view 60 degrees
CAMERA = np.array([0.0, 0.0, 0.015])  # in the dataset's sensor frame [m]
# columns: our x (image right), y (image down), z (out) in the dataset's axes; the camera looks along its +x
AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
T_WORLD_OBJECT = transform(np.eye(3), [0.1, 0.0, 0.2])
CAMERA_DISTANCE = 0.02205  # of the bundled digit-hsp [m]


@dataclass(frozen=True)
class Touch:
    """One tactile image: its name, its row of poses_sensors.txt, how strongly each pixel changed, how far the object is."""

    name: str
    row: Array
    change: NDArray[np.float32]
    distance: Array


def T_world_sensor(row: ArrayLike, camera_distance: float = CAMERA_DISTANCE) -> Array:
    """Our sensor frame in the world (4, 4) from a row of poses_sensors.txt: x y z [m], rotation axis (3), angle [rad]."""
    row = np.asarray(row, float)
    R = Rotation.from_rotvec(row[3:6] / np.linalg.norm(row[3:6]) * row[6]).as_matrix()
    apex = CAMERA + [camera_distance, 0.0, 0.0]
    return transform(R @ AXES, row[:3] + R @ apex)


def make_sensor(camera_distance: float, membrane_radius: float) -> Sensor:
    """The sensor with these optics; the pixel pitch follows from the field of view."""
    pitch = camera_distance / FOCAL_PX
    return Sensor("digit-hsp", IMAGE_SIZE_PX, (pitch, pitch), camera_distance, 0.003, membrane_radius)


def load_touches(folder: Path) -> list[Touch]:
    """All touches, with the distance (H, W) [m] from the camera to the object along the optical axis; inf: none."""
    background = read_image(folder / "background.png").astype(float)
    pinhole = make_sensor(CAMERA_DISTANCE, 0.0)
    touches = []
    for path in sorted((folder / "meshes").glob("*.obj")):
        mesh = read_mesh(path)
        caster = Caster(*mesh)
        for triplet in sorted((folder / path.stem).glob("triplet_*")):
            for k, row in enumerate(np.loadtxt(triplet / "poses_sensors.txt")):
                T = inverse(T_world_sensor(row)) @ T_WORLD_OBJECT
                distance = CAMERA_DISTANCE - caster.depths(pinhole, T[None])[0].astype(float)
                image = read_image(triplet / f"Image_heatmap_{k}.png").astype(float)
                change = ndimage.gaussian_filter(image - background, (2, 2, 0))
                name = f"{path.stem}/{triplet.name}/{k}"
                touches.append(Touch(name, row, np.linalg.norm(change, axis=-1).astype(np.float32), distance))
    return touches


def read_mesh(path: Path) -> tuple[Array, NDArray[np.int32]]:
    """Vertices [m] and faces of a household mesh, which need not be watertight to be seen from outside."""
    import trimesh

    mesh = trimesh.load_mesh(path, process=False)
    return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int32)


def predicted_mask(touch: Touch, camera_distance: float, membrane_radius: float) -> NDArray[np.bool_]:
    """Where the object is nearer to the camera than the membrane."""
    sensor = make_sensor(camera_distance, membrane_radius)
    rays = np.stack(np.meshgrid(*sensor.pixel_centres()), -1)
    return touch.distance < sensor.lift(rays)[..., 2] + camera_distance


def contrast(touch: Touch, mask: NDArray[np.bool_], band: int = 4) -> float:
    """How far the change falls across the mask's outline, per unit of its mean inside."""
    m = mask.astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    inner = (m > 0) & (cv2.erode(m, kernel, borderType=cv2.BORDER_REPLICATE) == 0)
    outer = (m == 0) & (cv2.dilate(m, kernel, borderType=cv2.BORDER_REPLICATE) > 0)
    if not inner.any() or not outer.any():
        return 0.0
    return float((touch.change[inner].mean() - touch.change[outer].mean()) / touch.change[mask].mean())


def fit(touches: list[Touch]) -> tuple[float, float]:
    """Camera distance and membrane radius [m] of the largest mean contrast: a grid, then a finer one about its best."""
    best = (0.022, 0.035)
    for steps, span in (((0.5e-3, 5e-3), 4), ((0.125e-3, 1.25e-3), 4), ((0.05e-3, 0.5e-3), 3)):
        grid = [
            (best[0] + i * steps[0], best[1] + j * steps[1])
            for i in range(-span, span + 1)
            for j in range(-span, span + 1)
            if best[1] + j * steps[1] > 0.018
        ]
        scores = [np.mean([contrast(t, predicted_mask(t, *p)) for t in touches]) for p in grid]
        best = grid[int(np.argmax(scores))]
    return best


def outline_error(touch: Touch, camera_distance: float, membrane_radius: float) -> float:
    """By how much [m] the predicted outline must grow (> 0) or shrink to lie where the change falls most steeply."""
    mask = predicted_mask(touch, camera_distance, membrane_radius)
    signed = ndimage.distance_transform_edt(~mask) - ndimage.distance_transform_edt(mask)
    shifts = np.arange(-12, 12.5, 0.5)
    scores = [contrast(touch, signed <= s, band=3) for s in shifts]
    return float(shifts[int(np.argmax(scores))] * camera_distance / FOCAL_PX)


def main() -> None:
    folder = Path(sys.argv[1]) / "hsp_digit_sim_ycb"
    touches = load_touches(folder)
    fitted = [t for t in touches if "triplet_1" in t.name or "triplet_2" in t.name]
    rows = {tuple(t.row) for t in fitted}
    names = {t.name for t in fitted}
    judged = [t for t in touches if t.name not in names and tuple(t.row) not in rows]
    result = fit(fitted)
    print(f"camera_distance_mm = {1e3 * result[0]:.2f}, membrane_radius_mm = {1e3 * result[1]:.1f}")
    print(f"pixel_pitch_mm = {1e3 * result[0] / FOCAL_PX:.5f}")
    for name, part in (("fitted", fitted), ("judged", judged)):
        errors = 1e3 * np.array([outline_error(t, *result) for t in part])
        deep = [_indentation(t, *result) for t in part]
        print(
            f"{name}: {len(part)} touches, outline off by {np.median(errors):+.2f} mm in the median, "
            f"{np.median(np.abs(errors)):.2f} mm absolute, {np.quantile(np.abs(errors), 0.9):.2f} mm at 90 %; "
            f"contrast {np.mean([contrast(t, predicted_mask(t, *result)) for t in part]):.3f}; "
            f"indentation {1e3 * min(deep):.2f} to {1e3 * max(deep):.2f} mm"
        )


def _indentation(touch: Touch, camera_distance: float, membrane_radius: float) -> float:
    sensor = make_sensor(camera_distance, membrane_radius)
    rays = np.stack(np.meshgrid(*sensor.pixel_centres()), -1)
    return float((sensor.lift(rays)[..., 2] + camera_distance - touch.distance).max())


if __name__ == "__main__":
    main()
