"""Triplets judged: three touches at once of a DIGIT that others simulated, on five household objects (hsp_digit_sim_ycb).

The data are those of Caddeo et al. (ICRA 2023). All objects lie at one pose in them, so the world is moved at random.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from geomtact.errors import InputError, NoPoseAgreesError
from geomtact.localizer import Localizer
from geomtact.se3 import Array, apply, inverse, random_rotations, transform
from geomtact.sensing.sensor import Sensor
from tools.studies.common.pose_error import add_s
from tools.studies.common.study import coverage_figures

SENSOR = "digit-hsp"
SHOWN = ("reading", "ideal")
POINTS = 50_000  # of ADD-S: on a can so many lie 0.6 mm from the nearest of as many others, 500 would lie 5 mm from it
TOLERANCE = 2e-3  # m that the object may miss a sensor by, or enter it beyond the gel, and still count as touching it
_CAMERA = (0.0, 0.0, 0.015)  # in the data's sensor frame [m]
# columns: our x (image right), y (image down), z (out) in the data's sensor frame; its camera looks along its +x
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_T_WORLD_OBJECT = transform(np.eye(3), [0.1, 0.0, 0.2])


@dataclass(frozen=True)
class Triplet:
    """One object touched by three sensors: their poses (3, 4, 4) in the world and its own (4, 4), and what they show."""

    name: str
    T_world_sensor: Array
    T_world_object: Array
    readings: list[Any]
    background: Any


@dataclass(frozen=True)
class Outcome:
    """The figures of the first ``touches`` sensors of a triplet. Lengths in millimetres, information in nats.

    Attributes
    ----------
    shown : "reading" of the data, "ideal" contact cast at the true pose, or "chance": a pose that touches the first sensor
    gain : log density at the true pose, relative to the uniform distribution on the first sensor's poses
    claimed : minus the entropy
    level : credible level of the true pose
    position_mm : from the object's centre in the first mode to its true place; inf where no pose agreed
    add_s_mm, probability : of the first mode
    touching : how many of all three sensors the object touches in the first mode, see :func:`touching`
    warned : whether a warning named a sensor as disagreeing
    ms : that localizing took
    """

    triplet: str
    shown: str
    touches: int
    gain: float
    claimed: float
    level: float
    position_mm: float
    add_s_mm: float
    probability: float
    touching: int
    warned: bool
    ms: float


def read_triplets(folder: Path, seed: int) -> dict[Path, list[Triplet]]:
    """The triplets of each mesh file [m] of the data, each in a world moved at random.

    Raises
    ------
    InputError
        The folder is not that of the data.
    """
    rng, sensor = np.random.default_rng([seed, 3]), Sensor.load(SENSOR)
    out: dict[Path, list[Triplet]] = {}
    for mesh in sorted((folder / "meshes").glob("*.obj")):
        for place in sorted((folder / mesh.stem).glob("triplet_*")):
            T_ours_world = transform(random_rotations(1, rng)[0], rng.uniform(-0.3, 0.3, 3))
            T = np.stack([sensor_pose(row, sensor) for row in np.loadtxt(place / "poses_sensors.txt")])
            readings = [place / f"Image_heatmap_{k}.png" for k in range(len(T))]
            triplet = Triplet(
                f"{mesh.stem}/{place.name}",
                T_ours_world @ T,
                T_ours_world @ _T_WORLD_OBJECT,
                readings,
                folder / "background.png",
            )
            out.setdefault(mesh, []).append(triplet)
    if not out:
        raise InputError(
            f"{folder}: expected hsp_digit_sim_ycb's meshes/NAME.obj and NAME/triplet_1/poses_sensors.txt; give its folder"
        )
    return out


def sensor_pose(row: ArrayLike, sensor: Sensor) -> Array:
    """Our sensor frame in the data's world (4, 4), of a row of poses_sensors.txt: x y z [m], axis (3), angle [rad]."""
    row = np.asarray(row, float)
    turned = Rotation.from_rotvec(row[3:6] / np.linalg.norm(row[3:6]) * row[6]).as_matrix()
    return transform(turned, row[:3]) @ transform(_AXES, np.array(_CAMERA) + [sensor.camera_distance, 0.0, 0.0])


def judge(
    localizer: Localizer, triplets: Sequence[Triplet], effort: str, seed: int, first: int = 0
) -> Iterator[list[Outcome]]:
    """Each triplet from ``first`` on localized from its first touch, its first two and all three: from the tactile
    images, and from ideal contacts.

    Before them stands the outcome of chance: the uniform distribution on the poses that touch the first sensor.
    """
    for number, triplet in enumerate(triplets[first:], first):
        rng = np.random.default_rng([seed, number])
        drawn, _ = localizer.space.sample(1, rng)
        out = [_outcome(localizer, triplet, "chance", 0, triplet.T_world_sensor[0] @ drawn[0], level=rng.random())]
        for shown in SHOWN:
            for n in range(1, len(triplet.readings) + 1):
                out.append(_localized(localizer, triplet, shown, n, effort, seed))
        yield out


def touching(localizer: Localizer, T_world_sensor: Array, T_world_object: Array) -> NDArray[np.bool_]:
    """Which of the sensors (n, 4, 4) the object touches at a pose (4, 4): its deepest point in the window lies between the
    membrane and the gel's depth, within ``TOLERANCE``."""
    depth = localizer.space.caster.penetration(localizer.sensor, inverse(T_world_sensor) @ T_world_object)
    return (depth >= -TOLERANCE) & (depth <= localizer.sensor.max_penetration + TOLERANCE)


def summarise(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Figures for what was shown and each number of touches: means, and quartiles [25 %, median, 75 %].

    ``compatible`` is the share of triplets in which the first mode touches all three sensors, ``touched`` that of the sensors.
    """
    out = []
    for shown, n in dict.fromkeys((o.shown, o.touches) for o in outcomes):
        some = [o for o in outcomes if (o.shown, o.touches) == (shown, n)]
        figures: dict[str, Any] = {"shown": shown, "touches": n, "n": len(some)}
        for name in ("position_mm", "add_s_mm", "gain", "claimed", "probability", "ms"):
            values = np.array([getattr(o, name) for o in some], float)
            figures[f"{name}_mean"] = float(values[np.isfinite(values)].mean())
            # where no pose agreed with all sensors it is infinitely far: no interpolation towards that
            figures[f"{name}_quartiles"] = np.quantile(values, [0.25, 0.5, 0.75], method="nearest").tolist()
        figures["compatible"] = float(np.mean([o.touching == 3 for o in some]))
        figures["touched"] = float(np.mean([o.touching / 3 for o in some]))
        figures["ruled_out"] = float(np.mean([not np.isfinite(o.gain) for o in some]))
        figures["warned"] = float(np.mean([o.warned for o in some]))
        out.append(figures | coverage_figures([o.level for o in some]))
    return out


def _localized(localizer: Localizer, triplet: Triplet, shown: str, n: int, effort: str, seed: int) -> Outcome:
    T, images, kind, background = triplet.T_world_sensor[:n], triplet.readings[:n], "reading", triplet.background
    if shown == "ideal":
        images = [localizer.simulate(pose).mask for pose in inverse(T) @ triplet.T_world_object]
        kind, background = "mask", None
    began = time.perf_counter()
    try:
        posterior = localizer.localize(images, kind, background, T, effort=effort, seed=seed)
    except NoPoseAgreesError:
        return _outcome(localizer, triplet, shown, n, None, gain=-np.inf, level=1.0, warned=True)
    ms = 1e3 * (time.perf_counter() - began)
    modes = posterior.modes(1)
    return _outcome(
        localizer,
        triplet,
        shown,
        n,
        modes[0].T if modes else None,
        gain=float(posterior.log_density(triplet.T_world_object)),
        claimed=-float(posterior.entropy_nats),
        level=float(posterior.credible_level(triplet.T_world_object)),
        probability=modes[0].probability if modes else 0.0,
        warned=posterior.diagnostics.disagrees,
        ms=ms,
    )


def _outcome(localizer: Localizer, triplet: Triplet, shown: str, n: int, T: Array | None, **told: Any) -> Outcome:
    """The outcome of an estimated pose ``T`` (4, 4), or of none."""
    told = {"gain": 0.0, "claimed": 0.0, "probability": 0.0, "warned": False, "ms": 0.0} | told
    off: dict[str, Any] = {"position_mm": np.inf, "add_s_mm": np.inf, "touching": 0}
    if T is not None:
        mesh, true = localizer.mesh, triplet.T_world_object
        apart = apply(T, mesh.centre[None])[0] - apply(true, mesh.centre[None])[0]
        off = {
            "position_mm": 1e3 * float(np.linalg.norm(apart)),
            "add_s_mm": 1e3 * float(add_s(true, T, mesh.surface_points(POINTS))[0]),
            "touching": int(touching(localizer, triplet.T_world_sensor, T).sum()),
        }
    return Outcome(triplet=triplet.name, shown=shown, touches=n, **off, **told)
