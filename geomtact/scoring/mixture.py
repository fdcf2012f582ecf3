"""Contacts of several patches, for which the score of a cell is overconfident.

Where two or three places of an object touch at once, a degree more or less of tilt decides which of them do. So the contact
that was simulated for the touch's own cell often shows but one of them, while that of a cell elsewhere, whose own contact
happens to look alike, wins. The likelihood is therefore a mixture: the contact is as simulated, or the cell's own contact
is one of its patches alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from geomtact.scoring.probability import chunks
from geomtact.sensing.contact import SoftMask
from geomtact.sensing.patches import patches
from geomtact.sensing.sensor import Sensor
from geomtact.threads import thread_count

# Summed share of the hypotheses that one patch alone is the contact. Chosen on 654 simulated touches of several patches on four
# objects: 0.1 to 0.3 gain 0.06 to 0.08 nats over none. On a gear, whose stored contacts have several patches, 0.15 costs 0.1.
_SINGLE_PATCH_SHARE = 0.15
_MOST_PATCHES = 3  # largest patches that get a hypothesis each; hand-set


def contact_hypotheses(mask: SoftMask, sensor: Sensor) -> tuple[list[float], list[SoftMask]]:
    """Hypotheses for the object's own contact behind the observed ``mask`` (h, w): their shares of the mixture, and their
    contacts (h, w)."""
    alone = patches(mask, sensor.pixel_area(mask.shape), _MOST_PATCHES)
    if len(alone) < 2:
        return [1.0], [mask]
    return [1 - _SINGLE_PATCH_SHARE] + [_SINGLE_PATCH_SHARE / len(alone)] * len(alone), [mask, *alone]


def mix_hypotheses(
    shares: Sequence[float],
    scores: Sequence[NDArray[np.float32]],
    log_weight: NDArray[np.floating],
    temperature: float,
) -> NDArray[np.float32]:
    """The scores (N,) of a mixture of likelihoods, that have ``shares`` (k,) and ``scores`` (k, N).

    Each likelihood, exp(score / temperature), is taken to the mean of one over the rows, whose measure has the log ``log_weight``
    (N,): so every component concerns the pose alone, however poorly it fits the object.
    """
    if len(scores) == 1:
        return scores[0]
    inverse = np.float32(1 / temperature)
    out = np.empty_like(scores[0])

    def weigh(score: NDArray[np.float32], part: slice) -> float:
        mass = score[part] * inverse
        mass += log_weight[part]
        top = mass.max()
        if top == -np.inf:
            return -np.inf
        mass -= top
        return float(top) + float(np.log(np.exp(mass, out=mass).sum()))

    def mix(part: slice) -> None:
        likely = [score[part] * inverse + added for score, added in zip(scores, constant, strict=True)]
        # the largest and what the others add to it: numpy's own logaddexp takes four times as long
        largest = np.maximum.reduce(likely)
        least = np.maximum(largest, np.finfo(np.float32).min)  # rows without any likelihood stay at -inf
        for each in likely:
            each -= least
            np.exp(each, out=each)
        with np.errstate(divide="ignore"):
            largest += np.log(np.add.reduce(likely))
        np.multiply(largest, np.float32(temperature), out=out[part])

    parts = chunks(len(out))
    with ThreadPoolExecutor(thread_count()) as pool:
        evidence = [np.logaddexp.reduce(list(pool.map(partial(weigh, score), parts))) for score in scores]
        constant = (np.log(shares) - evidence).astype(np.float32)
        list(pool.map(mix, parts))
    return out
