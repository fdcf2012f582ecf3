"""Several scores combined, each with a weight that is fitted to one index.

On a coarse grid the network alone gains most; on a fine one, with a known contact face, moments or overlap add information.
The choice is made on simulated touches, so that no score is computed that adds nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.scoring.calibration import CalibrationTouches, fit_to_scores
from geomtact.scoring.probability import Calibration
from geomtact.scoring.protocol import Scorer
from geomtact.scoring.vectors import VectorScorer
from geomtact.sensing.contact import SoftMask

RATIOS = (0.25, 0.5, 1.0)  # searched weights of a further score, each divided by its own temperature; hand-set
_PLACES, _TOUCHES = 15_000, 120  # places of the index and touches on which scores are compared; hand-set, for speed


@dataclass(frozen=True, eq=False)
class Product:
    """Sum of log likelihoods, each of ``scorers`` with its weight."""

    scorers: Sequence[Scorer]
    weights: Sequence[float]

    @property
    def name(self) -> str:
        """Such as "1 encoder + 0.25 iou"."""
        return " + ".join(f"{w:.3g} {s.name}" for w, s in zip(self.weights, self.scorers, strict=True))

    def score(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Score (P, n) of ``mask`` (h, w) at every pose."""
        out = np.float32(self.weights[0]) * self.scorers[0].score(index, mask)
        for scorer, weight in zip(self.scorers[1:], self.weights[1:], strict=True):
            out += np.float32(weight) * scorer.score(index, mask)
        return out


class Comparison:
    """Scores of the same touches at some places of an index, drawn at random, and at the true ones.

    Each drawn place stands for many, each true one for itself: a score gains no more information than the
    truth's own mass leaves.
    """

    def __init__(self, index: Index, touches: CalibrationTouches, seed: int = 0):
        rng = np.random.default_rng(seed)
        some = np.sort(rng.choice(index.places, min(_PLACES, index.places), replace=False))
        level, true = np.divmod(touches.ids[:_TOUCHES], index.places)
        places = np.concatenate([some, true])
        self.masks, self._ids = touches.masks[:_TOUCHES], np.arange(len(index.height))[:, None] * index.places + places
        self._index = index.at_places(places)
        weight = self._index.weight.astype(float)
        drawn = weight[:, : len(some)]
        drawn *= (1 - weight[:, len(some) :].sum()) / drawn.sum()
        self._weight = weight.ravel()
        self._true = level * len(places) + len(some) + np.arange(len(true))

    def scores(self, scorer: Scorer) -> list[NDArray[np.float32]]:
        """Scores (m,) of every touch."""
        if isinstance(scorer, VectorScorer):
            scorer = replace(scorer, stored=scorer.stored[self._ids.ravel()])
        return [scorer.score(self._index, mask).ravel() for mask in self.masks]

    def calibrated(self, scores: Sequence[NDArray[np.float32]]) -> Calibration:
        """The calibration of ``scores``, one array (m,) per touch."""
        return fit_to_scores(lambda i: scores[i], self._true, self._weight)


def choose(comparison: Comparison, candidates: Mapping[str, Scorer], least: float) -> dict[str, float]:
    """The scores that together gain most, with the weight of each.

    One more is added while it gains ``least`` nats. The first of the candidates is preferred while none gains ``least`` more.
    """
    scores = {name: comparison.scores(scorer) for name, scorer in candidates.items()}
    alone = {name: comparison.calibrated(each) for name, each in scores.items()}
    first = next(iter(candidates))
    best = max(alone, key=lambda name: alone[name].gain)
    chosen = {best if alone[best].gain > alone[first].gain + least else first: 1.0}

    def together(weights: Mapping[str, float]) -> Calibration:
        n = len(comparison.masks)
        return comparison.calibrated([sum(w * scores[name][i] for name, w in weights.items()) for i in range(n)])  # type: ignore[misc]

    reached = together(chosen)
    while len(chosen) < len(candidates):
        trials = [
            chosen | {name: ratio * reached.temperature / alone[name].temperature}
            for name in candidates
            if name not in chosen
            for ratio in RATIOS
        ]
        calibrated = [together(trial) for trial in trials]
        best_trial = int(np.argmax([c.gain for c in calibrated]))
        if calibrated[best_trial].gain < reached.gain + least:
            break
        chosen, reached = trials[best_trial], calibrated[best_trial]
    return chosen
