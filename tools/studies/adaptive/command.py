"""``python -m tools.studies adaptive``: what resolving a touch within its cells would gain, and what it costs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from geomtact.cli.options import CacheDir, Seed, Unit
from geomtact.cli.shell import print_table
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

SCHEMA = "geomtact/adaptive/3"


def judge_adaptive(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    touches: study_options.Touches = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    seed: Seed = 47,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge two ways to resolve a touch: opening cells of a grid, and sampling the density.

    Prints the rank of the true cell, the gain within it, and the sampler's information gain by the number of contacts.
    """
    from geomtact.contact_space.touches import random_touches
    from geomtact.evaluation import describe
    from geomtact.localizer import Localizer
    from geomtact.sensing.sensor import Sensor
    from tools.studies.adaptive import study

    content, strength = study_file.load(out, SCHEMA), study_options.noise_named(noise)
    gel = Sensor.load(sensor)
    for mesh in study_options.meshes(parts, unit, gel):
        grids = [Localizer.prepare(mesh, sensor=gel, max_poses=n, cache_dir=cache_dir) for n in study.ROOTS]
        settings = describe(grids[-1]) | {
            "touches": touches,
            "noise": {"name": noise.value, **asdict(strength)},
            "roots": list(study.ROOTS),
            "contacts": list(study.CONTACTS),
            "children": study.CHILDREN,
            "seed": seed,
        }

        def more(first: int, grids: list[Localizer] = grids) -> Iterator[Any]:
            made = random_touches(grids[-1].space, touches, seed, noise=strength)
            return study.judged(grids, made, seed, first)

        study_file.judged(out, content, settings, touches, "exploring", more, study.Outcome, study.summarise)
    _print(content["parts"])
    study_file.plot(content, plot)


def _print(parts: Mapping[str, Any]) -> None:
    rows = []
    for name, part in parts.items():
        f = part["figures"]
        for k, n in enumerate(part["settings"]["roots"]):
            quartiles = " ".join(f"{each:,.0f}" for each in f["rank_quartiles"][k])
            rows.append([name, f"{n:,}", f"{f['coarse_gain'][k]:.2f}", quartiles, f"{f['in_cell_gain'][k]:.2f}"])
    headings = ["object", "grid", "coarse gain [nats]", "rank: quartiles", "gain in the cell"]
    print_table(headings, rows, headings[1:])
    rows = []
    for name, part in parts.items():
        for s in part["figures"]["sampled"]:
            off, half = s["expected_less_gain"]
            coverage = " ".join(f"{100 * each:.0f}" for each in s["coverage"])
            missed = f"{100 * s['missed']:.1f}"
            first = f"{100 * s['first']:.1f} {100 * s['held']:.1f}"
            figures = [
                f"{s['contacts']:,.0f}",
                f"{s['gain']:.2f}",
                f"{off:+.2f} +- {half:.2f}",
                coverage,
                missed,
                first,
            ]
            rows.append([name, *figures])
    headings = [
        "object",
        "contacts",
        "information gain [nats]",
        "expected less measured",
        "coverage [%] at 50 80 90 95",
        "missed [%]",
        "first mode, right [%]",
    ]
    print_table(headings, rows, headings[1:])
