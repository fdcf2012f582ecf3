"""The study ``localize`` on elastic touches of another solver, tamaas (Frérot et al. 2020).

    python -m tools.studies.localize.other_solver pin head --touches 200 --out docs/results/judge_elastic.json

geomtact's own elastic contact makes the touches that its posteriors are calibrated on; here the same touches are computed
through an independent implementation instead. tamaas prescribes the load where a touch has a depth, so the load that
gives the depth is searched for.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import tamaas
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space import touch
from geomtact.contact_space.space import ContactSpace
from geomtact.se3 import Array
from tools.studies.localize.command import judge

_LONGEST_SIDE = 96  # pixels of the solver's grid
_DEPTH_ERROR = 0.005  # of the depth


def tamaas_mask(depth: ArrayLike, pitch: tuple[float, float]) -> NDArray[np.bool_]:
    """As ``geomtact.sensing.elastic.elastic_mask``, by tamaas, on a grid of at most 96 pixels along a side."""
    depth = np.asarray(depth, float)
    below = depth > 0
    out = np.zeros(depth.shape, bool)
    if not below.any():
        return out
    rows, cols = np.flatnonzero(below.any(1)), np.flatnonzero(below.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
    deepest = float(depth[box].max())
    part = np.maximum(depth[box], -deepest) / deepest
    h, w = part.shape
    coarser = min(1.0, _LONGEST_SIDE / max(h, w))
    size = max(4, round(w * coarser)), max(4, round(h * coarser))
    small = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    lengths = [h * pitch[1] / deepest, w * pitch[0] / deepest]
    touched = _touched(small, lengths).astype(np.float32)
    out[box] = (cv2.resize(touched, (w, h), interpolation=cv2.INTER_LINEAR) > 0.5) & below[box]
    return out


def _touched(depth: Array, lengths: list[float]) -> NDArray[np.bool_]:
    """Where a rigid body of ``depth`` (h, w), 1 at the deepest point, presses a half-space that it sinks 1 into."""
    tamaas.set_log_level(tamaas.LogLevel.error)
    model = tamaas.Model(tamaas.model_type.basic_2d, lengths, list(depth.shape))
    model.E, model.nu = 1.0, 0.0
    tamaas.ModelFactory.registerNonPeriodic(model, "DCFFT")
    kind = tamaas.PolonskyKeerRey.pressure
    load, low, high = 1.0 / np.sqrt(np.prod(lengths)), 0.0, np.inf  # mean pressure, of the order of a flat punch's
    pressure = np.zeros(depth.shape)
    for _ in range(40):
        solver = tamaas.PolonskyKeerRey(model, np.ascontiguousarray(depth), 1e-8, kind, kind)
        solver.setIntegralOperator("DCFFT")
        solver.solve(load)
        pressure = np.array(model.traction)
        model.operators["DCFFT"](model.traction, model.displacement)
        sunk = float((np.array(model.displacement) - depth)[pressure > 0].mean()) + 1
        if abs(sunk - 1) < _DEPTH_ERROR:
            break
        low, high = (load, high) if sunk < 1 else (low, load)
        guess = load * max(sunk, 0.05) ** -1.2
        load = guess if low < guess < high else (0.5 * (low + high) if np.isfinite(high) else 2 * load)
    return pressure > 0


def felt_by_tamaas(space: ContactSpace, T: Array, elastic: bool) -> NDArray[np.bool_]:
    """``contact_space.touch.simulate_mask`` with tamaas for the elastic gel: the same touch, another solver."""
    with mock.patch.object(touch, "elastic_mask", tamaas_mask):
        return touch.simulate_mask(space, T, elastic)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="+")
    parser.add_argument("--unit")
    parser.add_argument("--sensor", default="gelslim")
    parser.add_argument("--touches", type=int, default=200)
    parser.add_argument("--noise", default="moderate", choices=["none", "moderate", "heavy"])
    parser.add_argument("--effort", default="balanced", choices=["fast", "balanced", "exact"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--cache-dir", type=Path)
    given = vars(parser.parse_args())
    judge(**given, felt=felt_by_tamaas, solver=f"tamaas {tamaas.__version__}")


if __name__ == "__main__":
    main()
