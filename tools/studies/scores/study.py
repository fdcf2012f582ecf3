"""Scores side by side: the same touches judged through one score after another, and what each score costs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from geomtact.contact_space.index import Index
from geomtact.contact_space.store import default_cache_dir, open_index
from geomtact.contact_space.touches import Touch
from geomtact.geometry.approach import Approach
from geomtact.geometry.mesh import Mesh
from geomtact.localizer import Localizer
from geomtact.progress import Progress
from geomtact.scoring.catalogue import PIXELWISE, descriptor_of, vectors_file
from geomtact.scoring.moments import Moments
from geomtact.scoring.protocol import Scorer
from geomtact.scoring.vectors import VectorScorer, describe_index
from geomtact.sensing.sensor import Sensor
from tools.studies.common import study

_T = TypeVar("_T")


@dataclass(frozen=True)
class Scored(study.Outcome):
    """An outcome, with the time [ms] that comparing with every pose and weighing them took: ``score_ms``."""

    score_ms: float


@dataclass(frozen=True)
class PrepareTimes:
    """Seconds that building the index, describing its contacts and calibrating the score took; None where the cache held it."""

    index: float | None
    describe: float | None
    calibrate: float | None


def timed(step: Callable[[Progress], _T], progress: Progress | None = None) -> tuple[_T, float | None]:
    """What ``step`` makes, and the seconds that it took; None where it reports no progress, for then the cache held it."""
    reported = False

    def report(done: float, doing: str) -> None:
        nonlocal reported
        reported = True
        if progress:
            progress(done, doing)

    began = time.perf_counter()
    made = step(report)
    return made, time.perf_counter() - began if reported else None


def prepare(
    mesh: Mesh,
    sensor: Sensor,
    scorer: str,
    max_poses: int,
    cache_dir: Path | None,
    progress: Progress | None = None,
    approach: Approach | None = None,
) -> tuple[Localizer, PrepareTimes]:
    """A localizer with ``scorer``, and the time that each step took."""
    folder = cache_dir or default_cache_dir()
    index, index_s = timed(lambda report: open_index(mesh, sensor, approach, max_poses, folder, report), progress)
    found = descriptor_of(scorer, index)
    describe_s: float | None = 0.0  # of a score that compares no vectors
    if found is not None:
        descriptor, _ = found
        path = vectors_file(folder / index.key, descriptor)
        _, describe_s = timed(lambda report: describe_index(index, descriptor, path, report), progress)
    localizer, calibrate_s = timed(
        lambda report: Localizer.prepare(
            mesh, None, sensor, approach, scorer=scorer, max_poses=max_poses, cache_dir=folder, progress=report
        ),
        progress,
    )
    return localizer, PrepareTimes(index_s, describe_s, calibrate_s)


def bytes_per_pose(scorer: Scorer, index: Index) -> float:
    """Bytes that ``scorer`` reads of every pose to compare a touch with it; all that is stored, for one unknown here."""
    if isinstance(scorer, VectorScorer):
        return scorer.stored.nbytes / len(index)
    if isinstance(scorer, Moments):
        return index.moments.nbytes / len(index)
    if scorer.name in PIXELWISE:
        return (index.bits.nbytes + index.area.nbytes) / len(index)
    return index.bytes_per_pose


def judged(localizer: Localizer, touches: Sequence[Touch], effort: str, seed: int) -> Iterator[Scored]:
    """Localizes each touch; gives its outcome and the time of the score."""
    for outcome, posterior in study.judged(localizer, touches, effort, seed):
        # an image without contact is not scored
        score_ms = sum(posterior.timing_ms.get(stage, 0.0) for stage in ("score", "posterior"))
        yield Scored(**asdict(outcome), score_ms=score_ms)


def summarise(outcomes: Sequence[Scored], iou: Sequence[Scored], random_add_mm: float) -> dict[str, dict[str, Any]]:
    """``study.summarise``, with the score's time and, touch by touch, its gain over ``iou``: that score's outcomes on
    the same touches, or none."""
    out = study.summarise(outcomes, random_add_mm)
    others = study.groups(iou)
    for name, some in study.groups(outcomes).items():
        difference = [a.gain - b.gain for a, b in zip(some, others[name], strict=True)] if others else []
        n = len(difference)
        out[name] |= {
            "score_ms_median": float(np.median([o.score_ms for o in some])),
            "over_iou_mean": float(np.mean(difference)) if n else None,
            "over_iou_standard_error": float(np.std(difference, ddof=1) / np.sqrt(n)) if n > 1 else None,
        }
    return out


def over_parts(entries: Sequence[Mapping[str, Any]], outcomes: Sequence[Sequence[Scored]]) -> dict[str, Any]:
    """A score's figures over several objects: every object counts alike, and the coverage is that of all touches together.

    Parameters
    ----------
    entries : what the JSON holds of the score, an object each
    outcomes : on each object
    """
    figures = {}
    for name, together in study.groups([o for some in outcomes for o in some]).items():
        some = [entry["figures"][name] for entry in entries if name in entry["figures"]]
        figures[name] = {key: _over(key, [f[key] for f in some]) for key in some[0] if not key.startswith("coverage")}
        figures[name] |= {"n": len(together), **study.coverage_figures([o.level for o in together])}
    return {
        "bytes_per_pose": _over("bytes_per_pose", [entry["bytes_per_pose"] for entry in entries]),
        "prepare_s": {
            step: _over(step, [entry["prepare_s"][step] for entry in entries]) for step in entries[0]["prepare_s"]
        },
        "figures": figures,
    }


def _over(key: str, values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    if key.endswith("standard_error"):
        return float(np.linalg.norm(known) / len(known))
    return float(np.mean(known))
