"""Coarse to fine: the coarse cells of the nested grid are scored first, and only those with mass cell by cell.

A coarse cell is described by the mean of its cells' vectors and by how they spread about it. Were they normally distributed, with
variance v_j in component j, the mean of exp(-|f - g|^2 / t) over the coarse cell would be

    prod_j (1 + 2 v_j / t)^(-1/2) exp(-(f - mean g)_j^2 / (t + 2 v_j)),

so a coarse cell's score is that of all its cells, and one that is not expanded keeps its mass. The cost of a touch follows
its ambiguity and not the size of the grid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index, expand_runs
from geomtact.scoring.calibration import CalibrationTouches, best_floor, fit_calibration
from geomtact.scoring.encoder import EncoderScorer
from geomtact.scoring.mixture import contact_hypotheses, mix_hypotheses
from geomtact.scoring.probability import Calibration, posterior_log_prob
from geomtact.sensing.contact import SoftMask

SHARE = 0.98  # share of the mass that is scored cell by cell; hand-set
_LEADING = 64  # coarse cells among whose cells the best score is searched; hand-set
_CHUNK = 1 << 12  # coarse cells worked on at a time: they stay in the processor's cache


@dataclass(frozen=True, eq=False)
class CoarseScorer:
    """Scores of whole coarse cells, on the scale of the cells' scores.

    Attributes
    ----------
    cells : the scorer of the cells
    narrowing : (P B, d) t / (t + 2 v) of every coarse cell at every penetration, t being the cells' temperature
    narrowed : (P B, d) ``narrowing`` times the mean vector
    constant : (P B,) the score at a vector of zeros
    temperature : of the calibration of the cells' scores
    """

    cells: EncoderScorer
    narrowing: NDArray[np.float32]
    narrowed: NDArray[np.float32]
    constant: NDArray[np.float32]
    temperature: float
    name: str = "blocks of encoder"

    @classmethod
    def make(cls, cells: EncoderScorer, index: Index, temperature: float) -> CoarseScorer:
        """Over the coarse cells of ``index``, each cell weighed by its measure."""
        first, _ = index.coarse_runs
        weight = np.maximum(np.asarray(index.weight).reshape(-1), 1e-30)[:, None]
        total = np.add.reduceat(weight, first)
        middle = np.add.reduceat(weight * cells.stored, first) / total
        spread = np.maximum(np.add.reduceat(weight * cells.stored**2, first) / total - middle**2, 0)
        narrow = temperature / (temperature + 2 * spread)
        constant = 0.5 * temperature * np.log(narrow).sum(1) - (narrow * middle**2).sum(1)
        return cls(cells, _single(narrow), _single(narrow * middle), _single(constant), temperature)

    def score(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Score (P B,) of every coarse cell: under the normal model, the temperature times the log of the mean of
        exp(score / temperature) over its cells."""
        return self.trusted(index, self.cells.seen(index, mask))[0]

    def trusted(self, index: Index, seen: NDArray[np.float32]) -> tuple[NDArray[np.float32], np.float32]:
        """As :meth:`score`, for the vector ``seen`` (d,) of the observed contact, and how far the scores are trusted."""
        out = np.asarray(self.constant + self.narrowed @ (2 * seen) - self.narrowing @ seen**2)
        first, counts = index.coarse_runs
        leading = np.sort(np.argpartition(-out, min(_LEADING, len(out) - 1))[:_LEADING])
        trust = self.cells.trust(float(self.cells.of(expand_runs(first[leading], counts[leading]), seen).max()))
        return (out, trust) if trust == 1 else (self._scaled(seen, trust), trust)

    def _scaled(self, seen: NDArray[np.float32], by: np.float32) -> NDArray[np.float32]:
        """The scores (P B,) of the coarse cells when those of the cells are multiplied ``by`` a factor."""
        out = np.empty(len(self.constant), np.float32)
        half, ones = np.float32(0.5 * self.temperature), np.ones(len(seen), np.float32)
        for start in range(0, len(out), _CHUNK):
            some = slice(start, start + _CHUNK)
            narrow, off = by * (1 - self.narrowing[some]), self.narrowed[some] / self.narrowing[some]
            narrow += self.narrowing[some]
            np.divide(self.narrowing[some], narrow, out=narrow)
            off -= seen
            off *= off
            off *= by * narrow
            np.log(narrow, out=narrow)
            narrow *= half
            np.matmul(narrow - off, ones, out=out[some])
        return out


@dataclass(frozen=True)
class Rows:
    """Scores of runs of cells that together cover the grid.

    Attributes
    ----------
    first, runs : (N,) first pose id, ascending, and number of cells of each run; runs None for single cells
    score : (N,)
    log_prior : (N,) log mass of each run
    calibration : of the scores
    by : name of the score
    """

    first: NDArray[np.int64]
    runs: NDArray[np.int64] | None
    score: NDArray[np.float32]
    log_prior: NDArray[np.floating]
    calibration: Calibration
    by: str

    @property
    def log_prob(self) -> NDArray[np.floating]:
        """Log mass (N,) of each run, by its score."""
        return posterior_log_prob(self.score, self.log_prior, self.calibration)


@dataclass(frozen=True, eq=False)
class Cascade:
    """A score from coarse to fine, under the uniform prior.

    Attributes
    ----------
    coarse_scorer : of coarse cells
    coarse : calibration of the coarse cells' scores alone
    partly : calibration where cells are scored in some coarse cells only; None where that is not done
    """

    coarse_scorer: CoarseScorer
    coarse: Calibration
    partly: Calibration | None

    @classmethod
    def fit(
        cls, cells: EncoderScorer, fine: Calibration, index: Index, touches: CalibrationTouches, partly: bool
    ) -> Cascade:
        """Calibrated on ``touches``; ``fine`` is the calibration of the cells' scores where all are scored."""
        scorer = CoarseScorer.make(cells, index, fine.temperature)
        own = index.coarse_cell_of(touches.ids)
        coarse = fit_calibration(scorer, index, CalibrationTouches(touches.masks, own), np.exp(index.log_coarse_weight))
        if not partly:
            return cls(scorer, coarse, None)
        # a larger uniform mixture weight makes up for true poses in coarse cells that stay whole
        out = cls(scorer, coarse, replace(fine, floor=0.0))
        gains = []
        for mask, true in zip(touches.masks, touches.ids, strict=True):
            rows = out.expanded(index, mask)
            row = int(np.searchsorted(rows.first, true, "right")) - 1
            log_prob = rows.log_prob
            gains.append(log_prob[row] - rows.log_prior[row])
        floor, gain = best_floor(np.array(gains))
        return replace(out, partly=replace(fine, floor=floor, gain=gain))

    def to_json(self) -> dict[str, Any]:
        """What :meth:`from_json` reads."""
        out = {"temperature": self.coarse_scorer.temperature, "coarse": asdict(self.coarse)}
        return out if self.partly is None else out | {"partly": asdict(self.partly)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any], cells: EncoderScorer, index: Index) -> Cascade:
        scorer = CoarseScorer.make(cells, index, data["temperature"])
        partly = Calibration(**data["partly"]) if "partly" in data else None
        return cls(scorer, Calibration(**data["coarse"]), partly)

    def whole(self, index: Index, mask: SoftMask) -> Rows:
        """The coarse cells alone."""
        first, runs = index.coarse_runs
        shares, masks = contact_hypotheses(mask, index.sensor)
        scores = [self.coarse_scorer.score(index, each) for each in masks]
        score = mix_hypotheses(shares, scores, index.log_coarse_weight, self.coarse.temperature)
        return _possible(Rows(first, runs, score, index.log_coarse_weight, self.coarse, self.coarse_scorer.name))

    def expanded(self, index: Index, mask: SoftMask) -> Rows:
        """Coarse cells, and cell by cell those of them that hold ``SHARE`` of the mass."""
        first, counts = index.coarse_runs
        shares, masks = contact_hypotheses(mask, index.sensor)
        seen = [self.coarse_scorer.cells.seen(index, each) for each in masks]
        scores, trust = zip(*(self.coarse_scorer.trusted(index, each) for each in seen), strict=True)
        prior = index.log_coarse_weight
        score = mix_hypotheses(shares, scores, prior, self.coarse.temperature)
        log_prob = posterior_log_prob(score, prior, replace(self.coarse, floor=0.0))
        chosen = heaviest(np.exp(log_prob), SHARE)
        length = np.where(chosen, counts, 1)
        ids = expand_runs(first, length)
        runs, cell_prior = np.ones(len(ids), np.int64), index.log_weight[ids]
        # the coarse cells that stay whole are scored as their first cells, and then as a whole
        at, whole = (np.cumsum(length) - length)[~chosen], ~chosen
        runs[at], cell_prior[at] = counts[whole], prior[whole]
        cell_scores = [by * self.coarse_scorer.cells.of(ids, each) for by, each in zip(trust, seen, strict=True)]
        for cell_score, coarse_score in zip(cell_scores, scores, strict=True):
            cell_score[at] = coarse_score[whole]
        assert self.partly is not None
        cell_score = mix_hypotheses(shares, cell_scores, cell_prior, self.partly.temperature)
        return _possible(Rows(ids, runs, cell_score, cell_prior, self.partly, self.coarse_scorer.cells.name))


def _possible(rows: Rows) -> Rows:
    """The rows that have mass."""
    kept = rows.log_prior > -np.inf
    if kept.all() or rows.runs is None:
        return rows
    return replace(
        rows, first=rows.first[kept], runs=rows.runs[kept], score=rows.score[kept], log_prior=rows.log_prior[kept]
    )


def _single(x: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.ascontiguousarray(x, np.float32)


def heaviest(mass: NDArray[np.floating], share: float) -> NDArray[np.bool_]:
    """The heaviest (n,) that together hold at least ``share`` of ``mass`` (n,), and few more than it takes."""
    # bins a fiftieth of a nat wide, to 20 nats below the heaviest
    with np.errstate(divide="ignore"):
        below = np.log(mass.max()) - np.log(mass)
    bins = np.minimum(below * 50, 1000).astype(np.int32)
    held = np.cumsum(np.bincount(bins, mass))
    return bins <= np.searchsorted(held, share * held[-1])
