"""A score with its calibration for one index, fitted once and kept beside the index."""

from __future__ import annotations

import contextlib
import json
import zipfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.contact_space.store import lock_of
from geomtact.errors import MeshError
from geomtact.files import write_text, write_whole
from geomtact.progress import Progress
from geomtact.scoring.calibration import CalibrationTouches, fit_calibration, simulate_touches
from geomtact.scoring.catalogue import (
    DEFAULT_SCORER,
    PIXELWISE,
    check_name,
    descriptor_of,
    fingerprint,
    vectors_file,
)
from geomtact.scoring.encoder import EncoderScorer
from geomtact.scoring.evidence_model import EvidenceModel
from geomtact.scoring.mixture import contact_hypotheses, mix_hypotheses
from geomtact.scoring.moments import Moments
from geomtact.scoring.probability import Calibration, posterior_log_prob
from geomtact.scoring.protocol import Scorer
from geomtact.scoring.vectors import describe_index
from geomtact.sensing.contact import SoftMask

FORMAT = 15
# All constants are hand-set.
_USUAL = 0.9  # share of the touches whose distance to the nearest stored contact counts as usual
_OUTLIERS = 0.01  # share of the touches whose evidence, or best pose, counts as an outlier
_LEAST_GAIN = 0.05  # least mean information gain of a touch, below which preparing fails [nats]
TOUCHES, SEED = 250, 20_200_531  # number and seed of the simulated touches that scores are calibrated on
_LEARN = 0.6  # share of these touches that the moments are fitted to; the rest are held out


@dataclass(frozen=True)
class Rows:
    """Scores of all cells that have mass.

    Attributes
    ----------
    cells : (N,) pose ids, ascending
    score : (N,)
    log_prior : (N,) log mass of each
    calibration : of the scores
    by : name of the score
    """

    cells: NDArray[np.int64]
    score: NDArray[np.float32]
    log_prior: NDArray[np.floating]
    calibration: Calibration
    by: str

    @property
    def log_prob(self) -> NDArray[np.floating]:
        """Log mass (N,) of each, by its score."""
        return posterior_log_prob(self.score, self.log_prior, self.calibration)


@dataclass(frozen=True)
class FittedScorer:
    """A scorer and its calibration on one index.

    Attributes
    ----------
    name : as requested
    scorer, calibration : of the cells
    evidence_model : gives the likelihood of a touch, given the object
    """

    name: str
    scorer: Scorer
    calibration: Calibration
    evidence_model: EvidenceModel

    def rows(
        self, index: Index, mask: SoftMask, log_prior: NDArray[np.floating] | None = None, above: float = 0.0
    ) -> Rows:
        """Scores of every single cell that has mass.

        ``log_prior`` (N,) is the log mass of all cells, the uniform's where it is None. ``mask`` is the contact of the object
        drawn back by ``above`` [m]: a contour line of the depth map.
        """
        scorer, calibration = self.scorer, self.calibration
        cells, prior = index.possible, index.log_possible_weight
        if log_prior is not None:
            cells = np.flatnonzero(np.isfinite(log_prior))
            prior = log_prior[cells]
        shares, masks = contact_hypotheses(mask, index.sensor)
        scores = [index.deeper(scorer.score(index, each), above).reshape(-1) for each in masks]
        score = mix_hypotheses(shares, scores, index.log_weight, calibration.temperature)
        score = score if len(cells) == len(score) else score[cells]
        return Rows(cells, score, prior, calibration, scorer.name)

    def log_mass(self, index: Index, mask: SoftMask) -> NDArray[np.float64]:
        """Log mass (P, n) of every cell at all places of ``index``, under the uniform prior."""
        rows = self.rows(index, mask)
        out = np.full(index.height.size, -np.inf)
        out[rows.cells] = rows.log_prob
        return out.reshape(index.height.shape)


def fitted_scorer(
    name: str, index: Index, folder: Path | None = None, progress: Progress | None = None
) -> FittedScorer:
    """The scorer ``name`` calibrated for ``index``; read from ``folder`` where it was fitted before.

    ``name`` is one of ``SCORERS``, or the path of an encoder's or ResNet-50's weights (.safetensors).

    Raises
    ------
    UsageError
        No scorer of that name.
    InputError
        The file of weights cannot be used.
    MeshError
        The object can hardly be touched, so nothing can be calibrated; or its touches are all alike.
    """
    check_name(name)
    scorers: dict[str, Scorer] = dict(PIXELWISE)
    label, found = name, descriptor_of(name, index)
    if found is not None:
        descriptor, compared = found
        label = f"{Path(name).name}-{fingerprint(descriptor)}"
        path = None if folder is None else vectors_file(folder, descriptor)
        scorers[name] = compared(descriptor, describe_index(index, descriptor, path, progress))
    path = None if folder is None else folder / f"{label}.json"
    fitted = _fitted_before(name, path, scorers)
    if fitted is not None:
        return fitted
    with contextlib.ExitStack() as held:  # of two processes that would fit it, the second waits for the first
        if folder is not None:
            with contextlib.suppress(OSError):  # beside a read-only cache no lock can be written
                held.enter_context(lock_of(folder))
        return _fitted_before(name, path, scorers) or _fitted_now(name, path, scorers, index, progress)


def _fitted_before(name: str, path: Path | None, scorers: dict[str, Scorer]) -> FittedScorer | None:
    """The fit in ``path``; None where nothing does, or nothing that can be used."""
    if path is not None:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            return _from_json(name, json.loads(path.read_text("utf-8")), scorers)
    return None


def _fitted_now(
    name: str, path: Path | None, scorers: dict[str, Scorer], index: Index, progress: Progress | None
) -> FittedScorer:
    """Fitted on simulated touches, and written to ``path``."""
    folder = None if path is None else path.parent
    touches = _simulated(index, None if folder is None else folder / f"touches-{FORMAT}-{TOUCHES}.npz", progress)
    if len(touches.ids) < 40:
        raise MeshError(
            f"{index.mesh.name}: hardly any pose makes a contact that the sensor {index.sensor.name!r} can resolve; "
            "check the object's unit and the approach"
        )
    data = _fit(name, scorers, index, touches)
    if progress:
        progress(1.0, "calibrating the score")
    if data["calibration"]["gain"] < _LEAST_GAIN and name in ("moments", DEFAULT_SCORER):
        raise MeshError(_all_alike(index, touches, data["calibration"]["gain"]))
    if path is not None:
        with contextlib.suppress(OSError):  # a read-only cache costs the fit each time, no more
            write_text(path, json.dumps(data))
    return _from_json(name, data, scorers)


def _simulated(index: Index, path: Path | None, progress: Progress | None) -> CalibrationTouches:
    """The touches that every score on ``index`` is fitted on, read from ``path`` where they were simulated before."""
    if path is not None:
        with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return CalibrationTouches.load(path)
    touches = simulate_touches(index, TOUCHES, SEED, progress)
    if path is not None:
        with contextlib.suppress(OSError):
            write_whole(path, touches.save)
    return touches


def _fit(name: str, scorers: dict[str, Scorer], index: Index, touches: CalibrationTouches) -> dict[str, Any]:
    """All that is fitted, as the cache holds it."""
    n = round(_LEARN * len(touches.ids))
    learn, held_out = (
        CalibrationTouches(touches.masks[part], touches.ids[part]) for part in (slice(n), slice(n, None))
    )
    moments = Moments.fit(index, learn.masks, learn.ids)
    nearest = {
        each: float(np.quantile([-scorer.score(index, mask).max() for mask in held_out.masks], _USUAL))
        for each, scorer in scorers.items()
        if isinstance(scorer, EncoderScorer)
    }
    scorers = {**_limited(scorers, nearest), "moments": moments}
    evidence = [EvidenceModel(moments).evidence(index, mask) for mask in held_out.masks]
    data: dict[str, Any] = {
        "format": FORMAT,
        "moments": {
            "bias": moments.bias.tolist(),
            "covariance": moments.covariance.tolist(),
            "freedom": moments.freedom,
        },
        "usual": np.quantile(evidence, _OUTLIERS, axis=0).tolist(),
        "nearest": nearest,
    }
    # only the moments have learned from some of the touches
    calibration = fit_calibration(scorers[name], index, held_out if name == "moments" else touches)
    data["calibration"] = asdict(calibration)
    return data


def _from_json(name: str, data: dict[str, Any], scorers: dict[str, Scorer]) -> FittedScorer:
    if data["format"] != FORMAT:
        raise ValueError("another format")
    m = data["moments"]
    moments = Moments(np.array(m["bias"]), np.array(m["covariance"]), m["freedom"])
    scorers = {**_limited(scorers, data["nearest"]), "moments": moments}
    return FittedScorer(
        name,
        scorers[name],
        Calibration(**data["calibration"]),
        EvidenceModel(moments, tuple(data["usual"])),
    )


def _limited(scorers: dict[str, Scorer], nearest: dict[str, float]) -> dict[str, Scorer]:
    """``scorers`` with what is usual for the touches of an index."""
    return {
        name: replace(scorer, usual=nearest[name]) if isinstance(scorer, EncoderScorer) else scorer
        for name, scorer in scorers.items()
    }


def _all_alike(index: Index, touches: CalibrationTouches, gain: float) -> str:
    """Why the object cannot be localized, when its touches constrain no pose."""
    filled = float(np.mean([mask.mean() > 0.95 for mask in touches.masks]))
    why = (
        f"at {100 * filled:.0f} % of its poses the contact fills the window"
        if filled > 0.5
        else "its contacts differ by less than a touch's noise"
    )
    return (
        f"{index.mesh.name}: cannot be localized, because its touches on the sensor {index.sensor.name!r} are all alike: "
        f"{why}, and a touch gains {max(gain, 0):.2f} nats; use a sensor with a larger window, or an approach to where "
        "the object has edges"
    )
