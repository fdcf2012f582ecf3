"""From scores to probabilities: what a score is worth as evidence, measured on simulated touches.

A score divided by a temperature is taken as a log likelihood, and a small share of every posterior is the uniform
distribution, for what no score foresees. Both are chosen so that the poses of touches drawn uniformly over the contact
pose space, felt through elastic and rigid gels and noise of any strength up to heavy, come out as probable as possible:
the logarithmic score is proper, so what maximises it is calibrated (Gneiting and Raftery 2007).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.draw import draw_within
from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import CALIBRATION_NOISE, draw_noise, felt_mask, spoilt
from geomtact.scoring.protocol import Scorer
from geomtact.se3 import Array

TEMPERATURES = np.geomspace(0.01, 30.0, 120)  # in units of the spread of the scores, whatever their scale
_BINS = 1 << 14
_TINY = 1e-30  # probabilities below it are added up as logarithms: single precision ends near 1e-38
_SPREAD_TOUCHES = 10  # that the spread of the scores is taken from
FLOORS = np.geomspace(1e-3, 0.5, 16)
_SHAPE = {True: (72, 96), False: (96, 72)}  # of the simulated touches, for wide and for tall windows
_LEAST_CONTACT = 1e-6  # m^2


@dataclass(frozen=True)
class Touches:
    """Simulated touches with known poses: masks (h, w) over the window, and the pose id (n,) whose cell holds each."""

    masks: list[NDArray[np.bool_]]
    ids: NDArray[np.int64]


@dataclass(frozen=True)
class Calibration:
    """``log likelihood = score / temperature``; ``floor`` is the uniform's share of the posterior.

    ``gain`` is the mean information gained by the touches it was fitted on [nats]; ``usual`` the score of the best
    pose that all but one in fifty of them reached: an image below it is unlike any touch of the object.
    """

    temperature: float
    floor: float
    gain: float
    usual: float


def simulate_touches(index: Index, n: int, seed: int, progress: Callable[[float, str], None] | None = None) -> Touches:
    """``n`` touches uniform over the contact pose space, half elastic, with noise of any strength up to heavy.

    Poses are drawn within the cells, not at their centres: the score has to bridge what lies between.
    """
    rng = np.random.default_rng(seed)
    space = ContactSpace(index.mesh, index.sensor, index.approach)
    wide = bool(index.sensor.half_window[0] >= index.sensor.half_window[1])
    shape = _SHAPE[wide]
    pixel = float(4 * index.sensor.half_window.prod() / np.prod(shape))
    weight = index.weight.ravel().astype(float)
    total = np.cumsum(weight)
    masks: list[NDArray[np.bool_]] = []
    ids: list[int] = []
    for _ in range(100):
        drawn = np.searchsorted(total, rng.random(64) * total[-1])
        cells = np.minimum(drawn, len(weight) - 1)
        T, _, found = draw_within(index, space, cells, rng, tries=5)
        for pose, i in zip(T[found], cells[found], strict=True):
            mask = felt_mask(space, pose, elastic=len(masks) % 2 == 1, shape=shape)
            if mask.sum() * pixel < min(_LEAST_CONTACT, 12 * pixel):
                continue
            masks.append(spoilt(mask, space, draw_noise(CALIBRATION_NOISE, rng), rng))
            ids.append(int(i))
            if progress:
                progress(len(masks) / n, "simulating sensor noise")
            if len(masks) == n:
                return Touches(masks, np.array(ids))
    return Touches(masks, np.array(ids, np.int64))


def calibrate(scorer: Scorer, index: Index, touches: Touches) -> Calibration:
    """The temperature and floor under which the true poses of ``touches`` are most probable."""
    weight = np.asarray(index.weight).ravel()
    spread = float(np.median([scorer.score(index, mask).std() for mask in touches.masks[:_SPREAD_TOUCHES]]))
    temperatures = TEMPERATURES * max(spread, 1e-9)
    ratio = np.zeros((len(temperatures), len(touches.ids)))
    best_score = np.zeros(len(touches.ids))
    for i, (mask, true) in enumerate(zip(touches.masks, touches.ids, strict=True)):
        score = scorer.score(index, mask).ravel()
        best_score[i] = score.max()
        below, mass = _histogram(best_score[i] - score, weight)
        # the likelihood at the true pose over its mean, for all temperatures from one pass over the scores
        evidence = np.log(np.exp(-below / temperatures[:, None]) @ mass)
        ratio[:, i] = (score[true] - best_score[i]) / temperatures - evidence
    # the density at the truth is a mixture of the scored and the uniform one
    mixed = np.log((1 - FLOORS[:, None, None]) * np.exp(np.minimum(ratio, 500)) + FLOORS[:, None, None]).mean(2)
    best_floor, best = np.unravel_index(mixed.argmax(), mixed.shape)
    usual = float(np.quantile(best_score, 0.02))
    return Calibration(float(temperatures[best]), float(FLOORS[best_floor]), float(mixed.max()), usual)


def _histogram(below: NDArray[np.float32], weight: NDArray[np.float32]) -> tuple[Array, Array]:
    """How far below the best the scores lie, in fine bins (b,), and the uniform measure of the poses in each (b,)."""
    width = max(float(below.max()), 1e-9) / (_BINS - 1)
    bin_of = (below / np.float32(width)).astype(np.int32)
    mass = np.bincount(bin_of, weight, minlength=_BINS)
    middle = np.bincount(bin_of, weight * below, minlength=_BINS) / np.maximum(mass, 1e-300)
    return np.asarray(middle, float), np.asarray(mass, float)


def log_weights(index: Index) -> NDArray[np.float32]:
    """Log of the uniform measure of every pose's cell (N,); -inf where the housing forbids the pose."""
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(index.weight).ravel())


def posterior_log_prob(
    score: NDArray[np.float32], log_prior: NDArray[np.floating], calibration: Calibration
) -> tuple[Array, float]:
    """Log probability (N,) of every cell, and the log evidence: the mean of exp(score) under the prior.

    ``log_prior`` (N,) is the log mass of every cell, not normalised. The evidence takes the score as it is: divided by
    one object's temperature it could not be compared with another object's.
    """
    # normalised before it is rounded: a log density is given up to a constant, however large
    prior = (log_prior - _log_sum_exp(log_prior)).astype(np.float32)
    joint = score.ravel() * np.float32(1 / calibration.temperature) + prior
    floor, total, evidence = calibration.floor, _log_sum_exp(joint), _log_sum_exp(score.ravel() + prior)
    # written out, and in single precision, because numpy's logaddexp takes many times as long
    joint -= np.float32(total - np.log1p(-floor))
    prior += np.float32(np.log(floor))
    probability = np.exp(joint)
    probability += np.exp(prior)
    with np.errstate(divide="ignore"):
        log_prob = np.log(probability).astype(float)
    tiny = np.flatnonzero((probability < _TINY) & (prior > -np.inf))
    log_prob[tiny] = np.logaddexp(joint[tiny], prior[tiny], dtype=float)
    return log_prob, evidence


def _log_sum_exp(x: NDArray[np.floating]) -> float:
    top = x.max()
    return float(top + np.log(np.exp(x - top).sum(dtype=np.float64)))
