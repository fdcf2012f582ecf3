"""What a localization leaves behind: its files, ``result.json`` under the schema ``geomtact/localization/1``, and lines."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geomtact.files import write_bytes, write_text
from geomtact.json_values import plain, to_text
from geomtact.report.figure import draw
from geomtact.report.page import page
from geomtact.report.sensor_image import SensorImage
from geomtact.report.summary import caution, facts, summaries_of, table
from geomtact.report.turnable import turnable
from geomtact.se3 import quat_xyzw
from geomtact.versions import versions

if TYPE_CHECKING:
    from geomtact.inference.modes import Mode
    from geomtact.inference.posterior import Posterior

SCHEMA = "geomtact/localization/1"
REPORTS = ("html", "png")


def result(
    posterior: Posterior,
    modes: Sequence[Mode],
    settings: Mapping[str, Any] | None = None,
    timing_ms: Mapping[str, float] | None = None,
    candidates: Sequence[Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """The content of ``result.json``, ready for ``json.dumps``.

    Parameters
    ----------
    posterior : what was found
    modes : of the posterior, most probable first
    settings, timing_ms : added to the posterior's own; its own settings, which are the resolved ones, go first
    candidates : of an object identification, the most probable first
    """
    mesh, sensor = posterior.mesh, posterior.sensor
    return plain(
        {
            "schema": SCHEMA,
            "object": {"name": mesh.name, "sha256": mesh.sha256, "unit": mesh.unit},
            "sensor": sensor.name,
            **({} if candidates is None else {"candidates": candidates}),
            "frame": posterior.frame,
            "contact": bool(posterior.contact),
            "modes": [
                {
                    "probability": mode.probability,
                    "T": mode.T,
                    "translation_mm": 1e3 * np.asarray(mode.T)[:3, 3],
                    "quat_xyzw": quat_xyzw(mode.T),
                    "covariance": mode.covariance,
                    "observable": mode.observable,
                    "length": mode.length,
                }
                for mode in modes
            ],
            "information_gain_nats": posterior.information_gain_nats,
            "entropy_nats": posterior.entropy_nats,
            "effective_poses": posterior.effective_poses,
            "settings": {**(settings or {}), **posterior.settings},
            "diagnostics": asdict(posterior.diagnostics),
            "versions": versions(),
            "timing_ms": {**posterior.timing_ms, **(timing_ms or {})},
            "warnings": list(posterior.warnings),
        }
    )


def write_all(
    folder: Path,
    posterior: Posterior,
    modes: Sequence[Mode],
    shown: Sequence[SensorImage],
    settings: Mapping[str, Any] | None = None,
    timing_ms: Mapping[str, float] | None = None,
    candidates: Sequence[Mapping[str, Any]] | None = None,
    reports: Sequence[str] = REPORTS,
) -> dict[str, Any]:
    """Write posterior.npz, result.json and the reports into ``folder``, which is made if need be.

    Parameters
    ----------
    folder : where to
    posterior, modes : what was found
    shown : each sensor's image, see ``report.sensor_image``
    settings, timing_ms : added to the posterior's own in result.json
    candidates : of an object identification, the most probable first
    reports : which of ``REPORTS`` are written: report.html, report.png

    Returns
    -------
    dict
        The content of result.json.
    """
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    posterior.save(folder / "posterior.npz")
    summaries = summaries_of(posterior, modes)
    picture = draw(posterior, modes, summaries, shown) if reports else None
    if picture is not None and "png" in reports:
        write_bytes(folder / "report.png", picture.whole)
    timing = {**(timing_ms or {}), "report": 1e3 * (time.perf_counter() - began)}
    content = result(posterior, modes, settings, timing, candidates)
    if picture is not None and "html" in reports:
        view = turnable(posterior, modes, shown) if modes else None
        html = page(content, table(summaries), [*facts(posterior), *caution(summaries)], picture.bands, view)
        write_text(folder / "report.html", html)
    for name in set(REPORTS) - set(reports):  # of an earlier touch
        (folder / f"report.{name}").unlink(missing_ok=True)
    write_text(folder / "result.json", to_text(content))
    return content


def frame_line(n: int, posterior: Posterior) -> dict[str, Any]:
    """The ``n``-th image of a sequence: its contact (None if it could not be read), information and first mode."""
    first = next(iter(posterior.modes(1)), None)
    return {
        "frame": n,
        "contact": None if posterior.diagnostics.is_skipped else posterior.contact,
        "information_gain_nats": posterior.information_gain_nats if posterior.contact else None,
        "entropy_nats": posterior.entropy_nats if posterior.contact else None,
        "probability": None if first is None else first.probability,
        "T": None if first is None else first.T,
        "quat_xyzw": None if first is None else quat_xyzw(first.T),
        "translation_mm": None if first is None else 1e3 * first.T[:3, 3],
        "warnings": posterior.warnings,
    }


def to_line(content: Mapping[str, Any]) -> str:
    """JSON text without a line break."""
    return json.dumps(plain(content), allow_nan=False)
