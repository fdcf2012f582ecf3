"""What ``geomtact localize`` prints and writes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from geomtact.cli.request import Request
from geomtact.cli.shell import print_table

if TYPE_CHECKING:
    from geomtact.identification import Identification
    from geomtact.inference.modes import Mode
    from geomtact.inference.posterior import Posterior

MODES = 5


def give(
    request: Request,
    images: Sequence[Path],
    found: Identification,
    timing_ms: Mapping[str, float],
    out: Path | None,
    reports: Sequence[str],
    as_json: bool,
) -> None:
    """Print what was found, after stages that took ``timing_ms``, and write it into ``out``."""
    from geomtact.json_values import to_text
    from geomtact.report.result import result, write_all

    posterior = found.posterior
    began = time.perf_counter()
    modes = posterior.modes(MODES)
    timing = {**timing_ms, "modes": 1e3 * (time.perf_counter() - began)}
    settings = {
        "image": str(images[0]) if len(images) == 1 else [str(image) for image in images],
        "kind": request.kind,
        "prior": request.prior and str(request.prior),
        "rotate": request.mounting.rotate,
        "mirror": request.mounting.mirror,
        **request.values,
        "taken_from": request.sources,
        "cache_dir": request.cache_dir and str(request.cache_dir),
    }
    candidates = [asdict(candidate) for candidate in found.candidates] if len(found.candidates) > 1 else None
    if out is not None:
        from geomtact.report.sensor_image import sensor_images

        shown = sensor_images(posterior, found.localizer)
        content = write_all(out, posterior, modes, shown, settings, timing, candidates, reports)
    elif as_json:
        content = result(posterior, modes, settings, timing, candidates)
    if as_json:
        typer.echo(to_text(content), nl=False)
        return
    if candidates:
        _print_candidates(found)
    if posterior.contact or out is not None:
        _print(posterior, modes, out, reports)


def without_contact(request: Request, images: int, kind: str) -> str:
    """The message without contact; ``kind`` of the image as it was read."""
    where = "the image" if images == 1 else f"any of the {images} images"
    what = {"reading": "a tactile image", "height": "a depth map"}.get(kind, "a mask")
    advice = f"it was read as {what}; give --background, or another --kind"
    if kind == "mask":
        advice = "contact is where a mask is not 0; check the file, or touch more firmly"
    elif request.values["background"] is not None:
        advice = (
            "nothing stands out enough from the --background; check that it shows the untouched sensor, and touch more firmly; "
            "if the contact fills the window, touch an edge instead, since a flat face changes no colours inside its rim"
        )
    return f"no contact found in {where}; {advice}"


def _print_candidates(found: Identification) -> None:
    rows = [
        [c.name, f"{100 * c.probability:.1f} %", f"{c.log_evidence:.1f}", "yes" if c.is_outlier else ""]
        for c in found.candidates
    ]
    print_table(("object", "probability", "log evidence", "outlier"), rows, ("probability", "log evidence"))


def _print(posterior: Posterior, modes: Sequence[Mode], out: Path | None, reports: Sequence[str]) -> None:
    from geomtact.report.summary import HEADINGS, caution, facts, summaries_of, table

    typer.echo(f"{posterior.mesh.name} on {posterior.sensor.name}, {posterior.frame} frame")
    if modes:
        summaries = summaries_of(posterior, modes)
        print_table(HEADINGS, table(summaries), ["mode", "probability", "±"])
        for line in (*facts(posterior), *caution(summaries)):
            typer.echo(line)
    files = f"report.{' and .'.join(reports)}, " if reports else ""
    typer.echo(f"written: {out}/{files}result.json, posterior.npz" if out else "for a report, give --out DIR")
