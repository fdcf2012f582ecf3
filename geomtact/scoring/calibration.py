"""How a score becomes a likelihood: the temperature and the uniform mixture weight of a score, fitted on simulated touches.

(A sensor's colours are calibrated elsewhere: ``sensing/calibrate.py``.)

A score divided by a temperature is a log likelihood, and a small share of every posterior is the uniform distribution, for
errors that no score models. Both maximise the mean log probability of the true poses of simulated touches: uniform over the
contact pose space, on rigid and elastic gels, with noise of any strength up to heavy. The logarithmic score is proper, so
its maximum is calibrated (Gneiting and Raftery 2007).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.draw import draw_within
from geomtact.contact_space.index import Index
from geomtact.contact_space.touch import CALIBRATION_NOISE, LEAST_CONTACT, draw_noise, simulate_mask, spoilt
from geomtact.progress import Progress
from geomtact.scoring.probability import TINY, Calibration
from geomtact.scoring.protocol import Scorer
from geomtact.se3 import Array
from geomtact.sensing.noise import Noise

TEMPERATURES = np.geomspace(0.01, 30.0, 240)  # searched, in units of the spread of the scores; hand-set range
_BINS = 1 << 12  # of the histogram of scores, for speed
_SPREAD_TOUCHES = 10  # touches that give the spread of the scores; hand-set
FLOORS = np.geomspace(1e-3, 0.5, 16)  # searched uniform mixture weights; hand-set range
_SHAPE = (72, 96)  # pixels of the simulated touches
_TRIES = 20  # largest number of draws for each simulated touch
_BATCH = 4  # poses drawn at once for one that touches a sensor with a housing


@dataclass(frozen=True)
class CalibrationTouches:
    """Simulated touches with their poses: masks (h, w) over the window, and the pose id (n,) whose cell holds each."""

    masks: list[NDArray[np.bool_]]
    ids: NDArray[np.int64]

    def save(self, path: Path) -> None:
        masks = np.array(self.masks)
        np.savez(path, masks=np.packbits(masks), shape=masks.shape, ids=self.ids)

    @classmethod
    def load(cls, path: Path) -> CalibrationTouches:
        with np.load(path, allow_pickle=False) as data:
            shape = tuple(data["shape"])
            masks = np.unpackbits(data["masks"], count=int(np.prod(shape))).astype(bool)
            return cls(list(masks.reshape(shape)), data["ids"])


def simulate_touches(
    index: Index,
    n: int,
    seed: int,
    progress: Progress | None = None,
    elastic: bool | None = None,
    noise: Noise = CALIBRATION_NOISE,
) -> CalibrationTouches:
    """``n`` touches all over the contact pose space, with noise of any strength up to ``noise``; rigid and elastic in turn,
    unless ``elastic`` says which. Fewer than ``n`` where the object hardly makes a contact of any size.

    Poses lie anywhere within the cells, not at their centres: the score has to bridge what lies between. Each touch has random
    numbers of its own, so a last digit that differs between processors changes one touch and not those after it.

    Raises
    ------
    MeshError
        Hardly any pose touches a sensor that has a housing.
    """
    masks: list[NDArray[np.bool_]] = []
    ids: list[int] = []
    for k in range(n):
        rng = np.random.default_rng([seed, k])
        simulated = _simulated_mask(index, k % 2 == 1 if elastic is None else elastic, rng)
        if simulated is not None:
            masks.append(spoilt(simulated[0], index.space, draw_noise(noise, rng), rng))
            ids.append(simulated[1])
        if progress:
            progress((k + 1) / n, "simulating sensor noise")
    return CalibrationTouches(masks, np.array(ids, np.int64))


def _simulated_mask(index: Index, elastic: bool, rng: np.random.Generator) -> tuple[NDArray[np.bool_], int] | None:
    """The contact (h, w) of a random pose before noise, and the id of the pose's cell; None where no draw gives one."""
    shape = index.sensor.along(_SHAPE)
    pixel = index.sensor.pixel_area(shape)
    for _ in range(_TRIES):
        drawn = _drawn(index, rng)
        if drawn is None:
            continue
        mask = simulate_mask(index.space, drawn[0], elastic, shape)
        if mask.sum() * pixel >= min(LEAST_CONTACT, 12 * pixel):
            return mask, drawn[1]
    return None


def _drawn(index: Index, rng: np.random.Generator) -> tuple[Array, int] | None:
    """A pose (4, 4) drawn uniformly from the contact pose space, and the id of the cell that holds it.

    It is drawn from a cell, which is drawn by its measure; None where the cell hardly touches. A housing forbids most tilts of a
    large object, so that many a pose touches where the own rotation of its cell does not: there cells do not measure poses,
    which are drawn from the space itself, uniformly and in more time.
    """
    if index.sensor.housing_depth is not None:
        T, depth = index.space.sample(1, rng, batch=_BATCH)
        return T[0], int(index.lookup(T, depth)[0])
    cells = index.at_share(rng.random(1))
    T, _, found = draw_within(index, index.space, cells, rng, tries=5)
    return (T[0], int(cells[0])) if found[0] else None


def fit_calibration(scorer: Scorer, index: Index, touches: CalibrationTouches) -> Calibration:
    """The temperature and uniform mixture weight under which the true poses of ``touches`` are most probable."""
    weight = np.asarray(index.weight).ravel()
    return fit_to_scores(lambda i: scorer.score(index, touches.masks[i]).ravel(), touches.ids, weight)


def fit_to_scores(
    score_of: Callable[[int], NDArray[np.float32]], ids: NDArray[np.int64], weight: NDArray[np.floating]
) -> Calibration:
    """As :func:`fit_calibration`: ``score_of(i)`` gives the scores (N,) of touch i, whose true row is ``ids[i]``, and rows have
    measures ``weight`` (N,)."""
    first = [score_of(i) for i in range(min(_SPREAD_TOUCHES, len(ids)))]
    spread = float(np.median([score.std() for score in first]))
    temperatures = TEMPERATURES * max(spread, 1e-9)
    ratio = np.zeros((len(temperatures), len(ids)))
    for i, true in enumerate(ids):
        score = first[i] if i < len(first) else score_of(i)
        top = score.max()
        below, mass = _histogram(top - score, weight)
        # the likelihood at the true pose over its mean, for all temperatures from one pass over the scores
        terms = np.exp(below * np.float32(-1) / temperatures[:, None].astype(np.float32))
        evidence = np.log(np.maximum((terms @ mass).astype(float), TINY))
        ratio[:, i] = (score[true] - top) / temperatures - evidence
    found = [_best_floor(each) for each in ratio]
    best = int(np.argmax([gain for _, gain in found]))
    return Calibration(float(temperatures[best]), *found[best])


def _best_floor(ratio: Array) -> tuple[float, float]:
    """The uniform mixture weight under which the true poses are most probable, and their mean gain with it.

    ``ratio`` (n,) are the gains at the true poses without a mixture: the density there becomes one with the uniform.
    """
    gains = np.log((1 - FLOORS[:, None]) * np.exp(np.minimum(ratio, 500)) + FLOORS[:, None]).mean(1)
    return float(FLOORS[gains.argmax()]), float(gains.max())


def _histogram(
    below: NDArray[np.float32], weight: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How far below the best the scores lie, in those fine bins (b,) that hold any, and the measure in each (b,)."""
    width = max(float(below.max()), 1e-9) / (_BINS - 1)
    bin_of = (below / np.float32(width)).astype(np.int32)
    mass = np.bincount(bin_of, weight, minlength=_BINS)
    held = np.flatnonzero(mass)
    middle = np.bincount(bin_of, weight * below, minlength=_BINS)[held] / mass[held]
    return middle.astype(np.float32), mass[held].astype(np.float32)
