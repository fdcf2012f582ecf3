"""A score with its calibration for one index, fitted once and kept beside the index."""

from __future__ import annotations

import contextlib
import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.build import Progress
from geomtact.contact_space.index import Index
from geomtact.errors import MeshError, UsageError, nearest_name
from geomtact.files import write_whole
from geomtact.scoring.calibration import Calibration, Touches, calibrate, simulate_touches
from geomtact.scoring.descriptors import CLASSICAL
from geomtact.scoring.encoder import EncoderScorer, Tower, load_weights
from geomtact.scoring.moments import Moments
from geomtact.scoring.overlap import OVERLAPS
from geomtact.scoring.protocol import Scorer
from geomtact.scoring.vectors import Descriptor, VectorScorer, describe_index

FORMAT = 3
DESCRIPTORS: dict[str, Descriptor] = {**CLASSICAL}
SCORERS = (*OVERLAPS, *DESCRIPTORS, "moments")
_WEIGHTS = ".safetensors"
_FIT, _JUDGE = 300, 200  # touches the moments are learned from, and touches the temperature is chosen on


@dataclass(frozen=True)
class FittedScorer:
    """A scorer and what its scores are worth on one index."""

    scorer: Scorer
    calibration: Calibration

    def score(self, index: Index, mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Similarity (P, n) of ``mask`` (h, w) to every pose."""
        return self.scorer.score(index, mask)


def fitted_scorer(
    name: str, index: Index, folder: Path | None = None, progress: Progress | None = None
) -> FittedScorer:
    """The scorer ``name`` calibrated for ``index``; read from ``folder`` where it was fitted before.

    ``name`` is one of ``SCORERS``, or the path of an encoder's weights (.safetensors).

    Raises
    ------
    UsageError
        No scorer of that name.
    MeshError
        The object can hardly be touched, so nothing can be calibrated.
    """
    if name not in SCORERS and not name.endswith(_WEIGHTS):
        raise UsageError(f"no score named {name!r}{nearest_name(name, SCORERS)}")
    path = None if folder is None else folder / f"{_file_name(name)}.json"
    if path is not None:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            return _from_json(name, json.loads(path.read_text("utf-8")), index, folder, progress)
    touches = simulate_touches(index, _FIT + _JUDGE, seed=20_200_531, progress=progress)
    if len(touches.ids) < 40:
        raise MeshError(
            f"{index.mesh.name}: hardly any pose makes a contact that the sensor {index.sensor.name!r} can resolve; "
            "check the object's unit and the approach"
        )
    n = len(touches.ids) * _FIT // (_FIT + _JUDGE)
    if name == "moments":
        scorer: Scorer = Moments.fit(index, touches.masks[:n], touches.ids[:n])
    else:
        scorer = _unfitted(name, index, folder, progress)
    fitted = FittedScorer(scorer, calibrate(scorer, index, Touches(touches.masks[n:], touches.ids[n:])))
    if path is not None:
        with contextlib.suppress(OSError):  # a read-only cache costs the fit each time, no more
            write_whole(path, lambda temporary: temporary.write_text(json.dumps(_to_json(fitted)), "utf-8"))
    return fitted


def _unfitted(name: str, index: Index, folder: Path | None, progress: Progress | None) -> Scorer:
    """A scorer that learns nothing from touches."""
    if name in OVERLAPS:
        return OVERLAPS[name]
    learned = name.endswith(_WEIGHTS)
    descriptor = Tower(load_weights(Path(name))) if learned else DESCRIPTORS[name]
    # what the vectors depend on names their file: its settings, or its weights
    path = None if folder is None else folder / f"{descriptor.name}-{_fingerprint(descriptor)}.npy"
    stored = describe_index(index, descriptor, path, progress)
    return EncoderScorer(descriptor, stored) if learned else VectorScorer(descriptor, stored)


def _file_name(name: str) -> str:
    return f"encoder-{_fingerprint(Tower(load_weights(Path(name))))}" if name.endswith(_WEIGHTS) else name


def _fingerprint(descriptor: Descriptor) -> str:
    return hashlib.sha256(repr(descriptor).encode()).hexdigest()[:12]


def _to_json(fitted: FittedScorer) -> dict:
    out = {"format": FORMAT, "name": fitted.scorer.name, "calibration": asdict(fitted.calibration)}
    if isinstance(fitted.scorer, VectorScorer):
        out["descriptor"] = _fingerprint(fitted.scorer.descriptor)
    if isinstance(fitted.scorer, Moments):
        m = fitted.scorer
        out["moments"] = {"bias": m.bias.tolist(), "covariance": m.covariance.tolist(), "freedom": m.freedom}
    return out


def _from_json(name: str, data: dict, index: Index, folder: Path | None, progress: Progress | None) -> FittedScorer:
    if data["format"] != FORMAT:
        raise ValueError("another format")
    calibration = Calibration(**data["calibration"])
    if data["name"] != "moments":
        scorer = _unfitted(name, index, folder, progress)
        if isinstance(scorer, VectorScorer) and data["descriptor"] != _fingerprint(scorer.descriptor):
            raise ValueError("another descriptor")
        return FittedScorer(scorer, calibration)
    m = data["moments"]
    return FittedScorer(Moments(np.array(m["bias"]), np.array(m["covariance"]), m["freedom"]), calibration)
