"""Whether the likelihood is calibrated within the cell that holds the true pose, on gels that it was not fitted on.

    python -m tools.studies.adaptive.within_cell pin head --touches 200 --out docs/results/within-cell.json

The rest of the cell is the uniform measure, so the credible level of the true pose among poses of its cell is uniform where the
likelihood is calibrated. If it trusts the wrong gel, levels are near 0 or near 1 too often.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import kstest

from geomtact.cli.shell import print_table, progress_bar
from geomtact.contact_space import touch
from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touches import counts, penetrations
from geomtact.evaluation import describe
from geomtact.inference.explored import Density
from geomtact.inference.particles import Target
from geomtact.localizer import Localizer
from geomtact.log_mass import log_mean_exp
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery
from geomtact.se3 import Array
from geomtact.sensing.elastic import elastic_contact
from geomtact.sensing.noise import MODERATE
from tools.studies.adaptive.study import LEVELS, in_cell
from tools.studies.common import study_file
from tools.studies.localize.other_solver import tamaas_mask

SCHEMA = "geomtact/within-cell/1"
_LARGER = 1.02  # pixels, than is stated


def _thin(depth: NDArray, pitch: tuple[float, float], thickness: float) -> NDArray[np.bool_]:
    return elastic_contact(depth, pitch, thickness)[0]


# The gel: its solver in place of geomtact's for a half-space, None for a rigid one; and how much larger pixels are than stated.
GELS: dict[str, tuple[Callable[..., NDArray[np.bool_]] | None, float]] = {
    "rigid": (None, 1.0),
    "elastic half-space": (touch.elastic_mask, 1.0),
    "elastic half-space, by tamaas": (tamaas_mask, 1.0),
    "elastic, 4 mm thick": (partial(_thin, thickness=4e-3), 1.0),
    "elastic, 1 mm thick": (partial(_thin, thickness=1e-3), 1.0),
    "rigid, pixels 2 % larger": (None, _LARGER),
    "elastic half-space, pixels 2 % larger": (touch.elastic_mask, _LARGER),
}


def levels(index: Index, gel: str, n: int, seed: int) -> list[float]:
    """Credible level of the true pose among those of its cell, for ``n`` touches."""
    solver, larger = GELS[gel]
    pitch = (larger * index.sensor.pixel_pitch[0], larger * index.sensor.pixel_pitch[1])
    space = ContactSpace(index.mesh, replace(index.sensor, pixel_pitch=pitch))
    rng = np.random.default_rng(seed)
    out: list[float] = []
    while len(out) < n:
        for T, depth in zip(*space.sample(8, rng, penetrations(space)), strict=True):
            with mock.patch.object(touch, "elastic_mask", solver or touch.elastic_mask):
                mask = touch.simulate_mask(space, T, solver is not None)
            if len(out) < n and counts(space, mask):
                shown = touch.spoilt(mask, space, MODERATE, rng)
                query = ContactQuery.of(shown, index.sensor)
                cell = int(index.lookup(T[None], np.array([depth]))[0])
                target = Target(index, query, np.zeros(index.places), None)
                out.append(_level(Density(target, (0.0,) * len(POWERS)), T, in_cell(target, cell, rng)))
    return out


def _level(density: Density, T: Array, others: Array) -> float:
    """Mass of ``others`` (n, 4, 4) that are denser than ``T`` (4, 4), which counts for half."""
    each = density.of_powers(np.concatenate([T[None], others]))
    log_density = logsumexp(each - log_mean_exp(each.T), b=density.weights, axis=1)
    mass = np.exp(log_density - logsumexp(log_density))
    return float(mass[log_density > log_density[0]].sum() + 0.5 * mass[0])


def summarise(found: list[float]) -> dict[str, Any]:
    """Share of the levels that are at most each of ``LEVELS``, and the p value of their being uniform (Kolmogorov, Smirnov)."""
    each = np.array(found)
    return {"coverage": [float((each <= q).mean()) for q in LEVELS], "uniform_p": float(kstest(each, "uniform").pvalue)}


def main() -> None:
    parser = argparse.ArgumentParser(description="Calibration within the true cell, by gel.")
    parser.add_argument("parts", nargs="*", default=["pin", "head"], help="bundled objects or mesh files")
    parser.add_argument("--sensor", default="gelslim", help="name or TOML file")
    parser.add_argument("--touches", type=int, default=200, help="of each object on each gel")
    parser.add_argument("--seed", type=int, default=59)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    content, rows = study_file.load(options.out, SCHEMA), []
    for part in options.parts:
        localizer = Localizer.prepare(part, sensor=options.sensor)
        settings = describe(localizer) | {"touches": options.touches, "seed": options.seed}
        before = content["parts"].get(part)
        found = before["levels"] if study_file.begun(before, settings) else {}
        for gel in GELS:
            with progress_bar(f"touching {part}, {gel}"):
                found[gel] = found.get(gel) or levels(localizer.index, gel, options.touches, options.seed)
            figures = {name: summarise(each) for name, each in found.items()}
            study_file.keep(options.out, content, part, settings=settings, figures=figures, levels=found)
            shown = " ".join(f"{100 * share:.0f}" for share in figures[gel]["coverage"])
            rows.append([part, gel, shown, f"{figures[gel]['uniform_p']:.2g}"])
    print_table(["object", "gel", "in the 50, 80, 90, 95 % region [%]", "uniform: p"], rows)


if __name__ == "__main__":
    main()
