"""Several sensors judged: what each more of them adds, on objects that all of them touch at once (thesis 7.2, Figure 13)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from geomtact.evaluation import SimultaneousTouches, assess, localized
from geomtact.geometry.distance import PoseDistance
from geomtact.localizer import Localizer
from geomtact.se3 import Array
from tools.studies.common.pose_error import add_s
from tools.studies.common.study import MODES, coverage_figures, mean_with_interval

SENSORS = 5
_POINTS = 20_000  # for ADD-S, which says no less than the distance between points (0.3 mm on the pin)


@dataclass(frozen=True)
class FusedOutcome:
    """What the first ``sensors`` of a scene told together. Lengths in millimetres, information in nats.

    Attributes
    ----------
    gain : log density at the true pose, relative to the uniform distribution on the first sensor's poses
    claimed : minus the entropy
    level : credible level of the true pose
    mssd_mm, add_mm, add_s_mm, add10_mm : of the first mode, the last of the best of ten; inf where no pose agreed
    probability : of the first mode
    warned : whether a sensor was said to disagree
    ms : that localizing took
    """

    scene: int
    sensors: int
    gain: float
    claimed: float
    level: float
    mssd_mm: float
    add_mm: float
    add_s_mm: float
    add10_mm: float
    probability: float
    warned: bool
    ms: float


def fuse_scenes(
    localizer: Localizer, scenes: Iterable[SimultaneousTouches], first: int = 0, **options: Any
) -> Iterator[list[FusedOutcome]]:
    """Each scene from ``first`` on localized, with ``options`` of ``Localizer.localize``, from its first sensor, its first two,
    and so on."""
    distance, points = PoseDistance(localizer.mesh), localizer.mesh.surface_points(_POINTS)
    for number, scene in enumerate(islice(scenes, first, None), first):
        out = []
        for n in range(1, len(scene.touches) + 1):
            posterior, ms = localized(localizer, scene, n, **options)
            if posterior is None:
                out.append(FusedOutcome(number, n, -np.inf, 0.0, 1.0, np.inf, np.inf, np.inf, np.inf, 0.0, True, ms))
                continue
            T = scene.T_world_object
            found = assess(posterior, T, MODES, distance)
            out.append(
                FusedOutcome(
                    scene=number,
                    sensors=n,
                    gain=found.gain,
                    claimed=found.expected_gain,
                    level=found.level,
                    mssd_mm=float(1e3 * found.mssd[0]),
                    add_mm=float(1e3 * found.mean[0]),
                    add_s_mm=float(1e3 * add_s(T, found.poses[:1], points)[0]),
                    add10_mm=float(1e3 * found.mean.min()),
                    probability=found.probability,
                    warned=posterior.diagnostics.disagrees,
                    ms=ms,
                )
            )
        yield out


def summarise(outcomes: Sequence[FusedOutcome]) -> list[dict[str, Any]]:
    """Figures for each number of sensors; ``more`` is the mean gain over one sensor less, with its paired 95 % bootstrap
    interval, and ``ruled_out`` the share of scenes in which the true pose was given no probability: of the others are gain and
    claim."""
    gains = {n: _column(outcomes, n, "gain") for n in sorted({o.sensors for o in outcomes})}
    rng, out = np.random.default_rng(0), []
    for n, gain in gains.items():
        figures: dict[str, Any] = {"sensors": n, "n": len(gain), "ruled_out": float((~np.isfinite(gain)).mean())}
        kept = np.isfinite(gain)
        claimed = _column(outcomes, n, "claimed")
        figures |= {"gain_mean": float(gain[kept].mean()), "claimed_mean": float(claimed[kept].mean())}
        if n - 1 in gains:
            more = (gain - gains[n - 1])[np.isfinite(gain) & np.isfinite(gains[n - 1])]
            figures["more"] = mean_with_interval(more, rng)
        for name in ("mssd_mm", "add_mm", "add_s_mm", "add10_mm", "probability", "ms"):
            figures[f"{name}_median"] = float(np.median(_column(outcomes, n, name)))
        figures["warned"] = float(_column(outcomes, n, "warned").mean())
        out.append(figures | coverage_figures(_column(outcomes, n, "level")))
    return out


def _column(outcomes: Sequence[FusedOutcome], sensors: int, name: str) -> Array:
    """One field of all scenes with that many sensors."""
    return np.array([getattr(o, name) for o in outcomes if o.sensors == sensors], float)
