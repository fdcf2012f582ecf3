"""A study: touches at known poses are localized, and the posteriors are held against the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.contact_class import CLASSES, contact_class
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touches import Touch, random_touches
from geomtact.evaluation import LEVELS, assess, coverage, share_with_interval
from geomtact.geometry.distance import PoseDistance
from geomtact.inference.posterior import Posterior
from geomtact.localizer import Localizer
from geomtact.se3 import Array
from geomtact.sensing.noise import Noise

THESIS_PARTS = ("pin", "damping_pin", "head", "elbow_pipe")
MODES = 10  # as many as the thesis's best10 has poses
WRONG_MM = 10.0  # MSSD beyond which a first mode is wrong
RESAMPLES = 2000
CERTAIN = 0.5  # a first mode below this probability is one of high entropy
CLAIMED = (0.0, 0.01, 0.1, 0.3, 0.6, 0.9, 1.0)  # edges of the bins of what first modes hold
Felt = Callable[[ContactSpace, Array, bool], NDArray[np.bool_]]


@dataclass(frozen=True)
class Outcome:
    """What one touch told. Lengths in millimetres, information in nats.

    Attributes
    ----------
    gain : log density at the true pose, relative to the uniform distribution
    claimed : minus the entropy: the gain that the posterior itself expects
    level : credible level of the true pose
    mssd_mm, add_mm, mssd10_mm, add10_mm : of the first mode, and of the best of ten; inf without contact found
    probability : of the first mode
    ms : that localizing took
    contact : one of ``contact_class.CLASSES``
    """

    elastic: bool
    penetration_mm: float
    gain: float
    claimed: float
    level: float
    mssd_mm: float
    add_mm: float
    mssd10_mm: float
    add10_mm: float
    probability: float
    ms: float
    contact: str


def make_touches(
    space: ContactSpace,
    n: int,
    seed: int,
    noise: Noise,
    felt: Felt | None = None,
    elastic: bool | None = None,
    only: str | None = None,
) -> list[Touch]:
    """``n`` touches of the object of ``space`` on its sensor, geometric and elastic in turn unless ``elastic`` says which.

    ``felt`` (space, T, elastic) -> (H, W) bool replaces the elastic touches' masks: with another solver than the one
    that the posterior was calibrated with. ``only`` names a class of contact, as in ``touches.random_touches``.
    """
    touches = random_touches(space, n, seed, elastic, noise, only)
    if felt is None:
        return touches
    from geomtact.contact_space.touch import spoilt

    rng = np.random.default_rng([seed, n])
    return [
        replace(t, mask=spoilt(felt(space, t.T_sensor_object, True), space, noise, rng)) if t.elastic else t
        for t in touches
    ]


def judged(
    localizer: Localizer, touches: Sequence[Touch], effort: str, seed: int
) -> Iterator[tuple[Outcome, Posterior]]:
    """Localizes each touch and says how that went, with the posterior that tells it."""
    distance = PoseDistance(localizer.mesh)
    for touch in touches:
        T = touch.T_sensor_object
        began = time.perf_counter()
        posterior = localizer.localize(touch.mask, kind="mask", effort=effort, seed=seed)
        ms = 1e3 * (time.perf_counter() - began)
        found = assess(posterior, T, MODES, distance)
        largest, mean = 1e3 * found.mssd, 1e3 * found.mean
        outcome = Outcome(
            elastic=touch.elastic,
            penetration_mm=1e3 * touch.penetration,
            gain=found.gain,
            claimed=found.expected_gain,
            level=found.level,
            mssd_mm=float(largest[:1].min(initial=np.inf)),
            add_mm=float(mean[:1].min(initial=np.inf)),
            mssd10_mm=float(largest.min(initial=np.inf)),
            add10_mm=float(mean.min(initial=np.inf)),
            probability=found.probability,
            ms=ms,
            contact=contact_class(localizer.space, T),
        )
        yield outcome, posterior


def summarise(outcomes: Sequence[Outcome], random_add_mm: float) -> dict[str, dict[str, Any]]:
    """Figures over all touches, the geometric and the elastic ones; ``random_add_mm`` as of :func:`random_add`."""
    return {name: _figures(some, random_add_mm) for name, some in groups(outcomes).items()}


def groups(outcomes: Sequence[Outcome]) -> dict[str, list[Any]]:
    """Those outcomes that figures are given of together: all, the geometric and the elastic ones, where there are any."""
    found = {
        "all": list(outcomes),
        "geometric": [o for o in outcomes if not o.elastic],
        "elastic": [o for o in outcomes if o.elastic],
    }
    return {name: some for name, some in found.items() if some}


def by_class(outcomes: Sequence[Outcome]) -> dict[str, dict[str, Any]]:
    """Coverage and gain of the outcomes of each contact class, with 99 % binomial intervals."""
    out = {}
    for name in CLASSES:
        some = [o for o in outcomes if o.contact == name]
        if some:
            gain = float(np.mean([o.gain for o in some]))
            out[name] = {"n": len(some), "gain_mean": gain, **coverage_figures([o.level for o in some], 0.99)}
    return out


def mean_with_interval(values: Array, rng: np.random.Generator) -> list[float]:
    """The mean of ``values`` (n,) and the bounds of its 95 % bootstrap interval."""
    means = rng.choice(values, (RESAMPLES, len(values))).mean(1)
    return [float(values.mean()), *(float(bound) for bound in np.quantile(means, [0.025, 0.975]))]


def coverage_figures(levels: ArrayLike, confidence: float = 0.95) -> dict[str, Any]:
    """Coverage at the nominal masses of the credible levels (n,) of true poses, and the greatest error among them."""
    found = coverage(levels, LEVELS, confidence)
    return {
        "coverage": [asdict(c) for c in found],
        "coverage_error": max(abs(c.share - c.nominal) for c in found),
    }


def reliability(probability: ArrayLike, right: ArrayLike) -> list[dict[str, float]]:
    """First modes in bins of the ``probability`` (n,) that they claim: how many, their mean claim, and the share that is
    ``right`` (n,), with its 95 % binomial interval."""
    probability, right = np.asarray(probability, float), np.asarray(right, bool)
    bin_of = np.searchsorted(CLAIMED[1:-1], probability, side="right")
    out = []
    for b in np.unique(bin_of):
        some = bin_of == b
        share, low, high = share_with_interval(int(right[some].sum()), int(some.sum()))
        claimed = float(probability[some].mean())
        out.append({"n": int(some.sum()), "claimed": claimed, "share": share, "low": low, "high": high})
    return out


def random_add(distance: PoseDistance, space: ContactSpace, n: int = 200) -> float:
    """Expected ADD [m], modulo symmetry, between two random poses of the contact pose space, from ``n`` pairs."""
    T, _ = space.sample(2 * n, np.random.default_rng(0))
    return float(np.mean([distance.mean(a, b[None])[0] for a, b in zip(T[:n], T[n:], strict=True)]))


def expected_random_add(localizer: Localizer) -> float:
    """Expected ADD of a random guess [mm], in whose units the thesis gives its errors."""
    return 1e3 * random_add(PoseDistance(localizer.mesh), localizer.space)


def _figures(outcomes: Sequence[Outcome], random_add_mm: float) -> dict[str, Any]:
    numbers = [name for name in Outcome.__annotations__ if name != "contact"]
    column = {name: np.array([getattr(o, name) for o in outcomes], float) for name in numbers}
    n = len(outcomes)
    gain = column["gain"]
    out: dict[str, Any] = {
        "n": n,
        "gain_mean": float(gain.mean()),
        "gain_standard_error": float(gain.std(ddof=1) / np.sqrt(n)) if n > 1 else None,
        "claimed_mean": float(column["claimed"].mean()),
        **coverage_figures(column["level"]),
        "wrong": float((column["mssd_mm"] > WRONG_MM).mean()),
        "high_entropy": float((column["probability"] < CERTAIN).mean()),
    }
    names = ("gain", "mssd_mm", "add_mm", "mssd10_mm", "add10_mm", "probability", "ms")
    out |= {f"{name}_median": float(np.median(column[name])) for name in names}
    # the thesis's normalised pose distance
    out["normalised_add_median"] = out["add_mm_median"] / random_add_mm
    out["normalised_add10_median"] = out["add10_mm_median"] / random_add_mm
    return out
