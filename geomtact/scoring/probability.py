"""From scores to probabilities, at the moment of a touch (thesis 6.1): score, prior and uniform mixture weight in one step."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.threads import thread_count

TINY = 1e-30  # probability below which sums are made of logarithms: single precision ends near 1e-38
_CHUNK = 1 << 18  # rows worked on at a time


@dataclass(frozen=True)
class Calibration:
    """``log likelihood = score / temperature``; ``floor`` is the uniform mixture weight of the posterior.

    ``gain`` is the mean information gained by the touches it was fitted on [nats].
    """

    temperature: float
    floor: float
    gain: float


def posterior_log_prob(
    score: NDArray[np.float32], log_prior: NDArray[np.floating], calibration: Calibration
) -> NDArray[np.float32]:
    """Log probability (N,) of every row; ``log_prior`` (N,) is the log mass of every row, normalised."""
    score, prior, floor = score.ravel(), log_prior.astype(np.float32, copy=False), calibration.floor
    out, mass = np.empty(len(score), np.float32), np.empty(len(score), np.float32)
    inverse = np.float32(1 / calibration.temperature)

    # in single precision and in chunks: a million rows are many megabytes a pass
    def weigh(part: slice) -> tuple[float, float]:
        joint, likely = out[part], mass[part]
        np.multiply(score[part], inverse, out=joint)
        joint += prior[part]
        top = joint.max(initial=-np.inf)
        if top == -np.inf:
            likely.fill(0)
            return -np.inf, -np.inf
        np.subtract(joint, top, out=likely)
        np.exp(likely, out=likely)
        return float(top), float(top) + float(np.log(likely.sum()))  # numpy adds up in pairs: exact enough

    def mix(part: slice, top: float) -> None:
        joint, likely, mine = out[part], mass[part], prior[part]
        joint -= np.float32(total)
        if floor == 0:
            return
        likely *= np.float32((1 - floor) * np.exp(top - total))
        likely += np.exp(mine) * np.float32(floor)
        if likely.min(initial=1) > TINY:
            np.log(likely, out=joint)
            return
        # a probability too small for single precision is added up as logarithms
        tiny = np.flatnonzero((likely < TINY) & (mine > -np.inf))
        kept = np.logaddexp(joint[tiny] + np.log1p(-floor), mine[tiny] + np.log(floor), dtype=float)
        with np.errstate(divide="ignore"):
            np.log(likely, out=joint)
        joint[tiny] = kept

    parts = chunks(len(out))
    with ThreadPoolExecutor(thread_count()) as pool:
        tops, sums = zip(*pool.map(weigh, parts), strict=True)
        total = float(np.logaddexp.reduce(sums))
        list(pool.map(mix, parts, tops))
    return out


def chunks(n: int) -> list[slice]:
    """``n`` rows in slices large enough for a thread."""
    return [slice(start, start + _CHUNK) for start in range(0, n, _CHUNK)]
