"""Touches judged by the whole distribution: a proper score in millimetres, and tests of calibration that look at all of it.

Energy score: Gneiting and Raftery, JASA 2007, eq. 22. TARP: Lemos et al., ICML 2023. Both are worked out from poses drawn of
the posterior; the gain (``study.Outcome``) is the logarithmic score of its density.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomtact.contact_space.touches import Touch
from geomtact.evaluation import share_with_interval
from geomtact.geometry.distance import PoseDistance, mode_radius, mssd
from geomtact.geometry.mesh import Mesh
from geomtact.inference.posterior import Posterior
from geomtact.localizer import Localizer
from geomtact.se3 import Array, apply
from tools.studies.common import study

DRAWS = 200  # poses of a posterior
BINS = 10  # of a histogram of levels
RECALLED = (1, 2, 5, 10)  # modes
_POINTS = 64


@dataclass(frozen=True)
class Judged(study.Outcome):
    """An outcome, with figures of the whole distribution.

    Attributes
    ----------
    energy_mm : energy score; its mean is least for the true distribution
    tarp : share of the posterior that is nearer than the truth to a pose drawn at random: uniform if it is calibrated
    recall : number of the first mode, of ten, that is right (``study.WRONG_MM``); 0 if none is
    held : whether the truth lies within the first mode (``geometry.distance.mode_radius``), which states its probability
    """

    energy_mm: float
    tarp: float
    recall: int
    held: bool


def judge(localizer: Localizer, touches: Sequence[Touch], effort: str, seed: int, first: int = 0) -> Iterator[Judged]:
    """Localizes each of ``touches`` from the ``first`` on, and holds the posterior against the truth."""
    judged = study.judged(localizer, touches[first:], effort, seed)
    for number, (outcome, posterior) in enumerate(judged, first):
        T, rng = touches[number].T_sensor_object, np.random.default_rng([seed, 53, number])
        if not posterior.contact:
            yield Judged(**asdict(outcome), energy_mm=np.inf, tarp=1.0, recall=0, held=False)
            continue
        drawn = posterior.sample(DRAWS, rng)
        reference = localizer.space.sample(1, rng)[0][0]
        yield Judged(
            **asdict(outcome),
            energy_mm=1e3 * energy_score(drawn, T, localizer.mesh),
            tarp=tarp_level(drawn, T, reference, PoseDistance(localizer.mesh)),
            recall=first_right(posterior, T),
            held=outcome.add_mm <= 1e3 * mode_radius(localizer.mesh),
        )


def energy_score(drawn: ArrayLike, T: ArrayLike, mesh: Mesh) -> float:
    """Energy score [m] of a distribution, of which poses (n, 4, 4) are ``drawn``, at the true pose ``T`` (4, 4).

    The mean distance of a pose drawn from the truth, less half of that between two drawn: proper, since the mean distance of
    corresponding points is of negative type, and so is its mean over the images under the finite symmetries of ``mesh``, where
    truth and drawn poses may be any of them. That mean is not 0 for the true pose itself, so that an object with such symmetries
    scores more than nothing even if its pose is certain. Of a continuous symmetry those points count that it leaves in
    place: of each point the nearest on the axis, or the centre.
    """
    drawn = np.asarray(drawn, float)
    half = len(drawn) // 2
    points, symmetry = mesh.surface_points(_POINTS), mesh.symmetry
    images = np.eye(4)[None] if symmetry is None else symmetry.elements
    if symmetry is not None and symmetry.kind == "sphere":
        points = symmetry.centre[None]
    elif symmetry is not None and symmetry.axis is not None:
        points = symmetry.centre + np.outer((points - symmetry.centre) @ symmetry.axis, symmetry.axis)

    def apart(a: Array, b: Array) -> float:
        here, there = apply(a, points), np.stack([apply(b @ S, points) for S in images])
        return float(np.linalg.norm(there - here, axis=-1).mean())

    to_truth = apart(np.broadcast_to(np.asarray(T, float), drawn.shape), drawn)
    return to_truth - 0.5 * apart(drawn[:half], drawn[half : 2 * half])


def tarp_level(drawn: ArrayLike, T: ArrayLike, reference: ArrayLike, distance: PoseDistance) -> float:
    """Share of poses ``drawn`` (n, 4, 4) that lie nearer to the ``reference`` pose (4, 4) than the truth ``T`` (4, 4) does.

    Uniform over touches if the poses come from a calibrated posterior, whatever draws the reference, as long as that does not
    look at the truth.
    """
    drawn, T = np.asarray(drawn, float), np.asarray(T, float)
    off = distance.mean(reference, np.concatenate([T[None], drawn]))
    return float((off[1:] < off[0]).mean())


def first_right(posterior: Posterior, T: Array) -> int:
    """Number, from 1, of the first of ten modes that is right; 0 if none is."""
    poses = np.array([mode.T for mode in posterior.modes(study.MODES)]).reshape(-1, 4, 4)
    right = np.flatnonzero(1e3 * mssd(T, poses, posterior.mesh) <= study.WRONG_MM)
    return int(right[0]) + 1 if len(right) else 0


def summarise(outcomes: Sequence[Judged], random_add_mm: float) -> dict[str, dict[str, Any]]:
    """``study.summarise``, with the figures of the whole distribution and, of all touches, those of each class of contact."""
    out = study.summarise(outcomes, random_add_mm)
    for name, some in study.groups(outcomes).items():
        energy = np.array([o.energy_mm for o in some])
        ms = np.array([o.ms for o in some])
        out[name] |= {
            "energy_mm_mean": float(energy.mean()),
            "energy_mm_standard_error": float(energy.std(ddof=1) / np.sqrt(len(some))) if len(some) > 1 else None,
            "levels": uniformity([o.level for o in some]),
            "tarp": uniformity([o.tarp for o in some]),
            "recall": {str(k): share_with_interval(sum(1 <= o.recall <= k for o in some), len(some)) for k in RECALLED},
            "reliability": study.reliability([o.probability for o in some], [o.held for o in some]),
            "ms_quantiles": [float(q) for q in np.quantile(ms, [0.1, 0.5, 0.9])],
        }
    out["all"]["classes"] = study.by_class(outcomes)
    for name, figures in out["all"]["classes"].items():
        figures["levels"] = uniformity([o.level for o in outcomes if o.contact == name])
    return out


def uniformity(levels: ArrayLike) -> dict[str, Any]:
    """Counts (``BINS``,) of levels (n,) in [0, 1], which are uniform if they are of calibrated posteriors, and how probable as
    large a deviation is if so (Kolmogorov and Smirnov)."""
    from scipy.stats import kstest

    levels = np.asarray(levels, float)
    counts, _ = np.histogram(levels, BINS, (0, 1))
    return {"counts": counts.tolist(), "p": float(kstest(levels, "uniform").pvalue)}
