"""Writes all of a localization's files into one folder."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geomtact.files import write_bytes, write_text
from geomtact.json_values import to_text
from geomtact.report.figure import draw
from geomtact.report.page import page
from geomtact.report.result import result
from geomtact.report.sensor_image import SensorImage
from geomtact.report.summary import caution, facts, summaries_of, table
from geomtact.report.turnable import turnable

if TYPE_CHECKING:
    from geomtact.inference.modes import Mode
    from geomtact.inference.posterior import Posterior

REPORTS = ("html", "png")


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
