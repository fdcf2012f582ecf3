"""``report.html``: one file with everything in it, readable without a network, in light and in dark."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

from geomtact.report.summary import HEADINGS, percent

_AXES = {
    "sensor": ": x along image columns, y along image rows downwards, z out of the sensor towards the object",
    "world": " of the sensors' poses",
}


def page(
    content: dict[str, Any],
    rows: Sequence[Sequence[str]],
    facts: Sequence[str],
    pictures: dict[str, bytes],
    turnable: dict[str, Any] | None = None,
) -> str:
    """The text of report.html.

    Parameters
    ----------
    content : of result.json
    rows : the modes as a table, under ``summary.HEADINGS``
    facts : sentences under the title
    pictures : PNGs "touch", "modes" and "marginals"; a missing one is left out
    turnable : content of the 3D view, see ``report.turnable``
    """
    name, sensor = escape(content["object"]["name"]), escape(content["sensor"])
    parts = [f"<h1>{name} on {sensor}</h1>"]
    parts += [f'<p class="warning">{escape(text)}</p>' for text in content["warnings"]]
    parts += ["<p>" + "<br>".join(map(escape, facts)) + "</p>"]
    if rows:
        parts += ["<h2>Most probable poses</h2>", _table(HEADINGS, rows)]
        parts += [
            f"<p>In the {escape(content['frame'])} frame{_AXES[content['frame']]}. ± is the standard deviation within the "
            "mode, in its least certain direction. Tilts are about x and y, turns about z, through the middle of the contact. "
            "The 4x4 matrices are in result.json and below.</p>"
        ]
    if turnable is not None:
        parts += _turnable(turnable, [mode["probability"] for mode in content["modes"]])
    parts += _picture("The touch", "the image and the contact found in it", pictures.get("touch"))
    parts += _picture(
        "The modes", "simulated contacts over the observed outline, and the object there", pictures.get("modes")
    )
    parts += _picture(
        "Distribution of each coordinate", "marginal distributions of position and turn", pictures.get("marginals")
    )
    if "marginals" in pictures:
        parts += [
            "<p>Turn and tilt are relative to mode 1, modulo the object's symmetry. The dashed line is mode 1.</p>"
        ]
    parts += _folded("Poses T (object to " + content["frame"] + " frame, metres)", [m["T"] for m in content["modes"]])
    timing = {stage: f"{ms:,.1f}" for stage, ms in content["timing_ms"].items()}
    parts += _folded("Settings", content["settings"])
    parts += _folded("Timing [ms]", timing)
    parts += _folded("Versions", content["versions"])
    return document(f"{name} on {sensor}", "\n".join(parts))


def document(title: str, body: str, style: str = "") -> str:
    """The text of an HTML file with a ``title`` and ``body`` in HTML, and ``style`` besides that of all pages."""
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>\n{asset('page.css')}{style}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def asset(name: str) -> str:
    """A script or style that stands beside this module."""
    return files("geomtact.report").joinpath(name).read_text("utf-8")


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(h)}</th>" for h in headings)
    lines = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f'<div class="table"><table>\n<tr>{head}</tr>\n' + "\n".join(lines) + "\n</table></div>"


def _turnable(content: dict[str, Any], probabilities: Sequence[float]) -> list[str]:
    tabs = [f'<button role="tab" type="button">mode {k}: {percent(p)}</button>' for k, p in enumerate(probabilities, 1)]
    return [
        "<h2>The object at each mode</h2>",
        '<section id="scene">',
        f'<div role="tablist" aria-label="modes">{"".join(tabs)}</div>',
        '<canvas tabindex="0" role="img"></canvas>',
        "<p>Blue: the sensor's window. Orange: the border of the observed contact. Drag, or press the arrow keys on the "
        "picture, to turn it. Click it to zoom with the wheel. The number keys choose a mode. "
        '<label><input type="checkbox" checked> Probable places of the first contact on the object, from rare (blue) to most '
        "probable (yellow)</label></p>",
        "</section>",
        f'<script id="scene-data" type="application/json">{json.dumps(content)}</script>',
        f"<script>\n{asset('turnable.js')}</script>",
    ]


def _picture(title: str, description: str, png: bytes | None) -> list[str]:
    if png is None:
        return []
    data = base64.b64encode(png).decode("ascii")
    return [f"<h2>{escape(title)}</h2>", f'<img alt="{escape(description)}" src="data:image/png;base64,{data}">']


def _folded(title: str, value: Mapping[str, object] | Sequence[Sequence[Sequence[float]]]) -> list[str]:
    if not value:
        return []
    if isinstance(value, Mapping):
        text = "\n".join(
            f"{key}: {entry if isinstance(entry, str) else json.dumps(entry)}" for key, entry in value.items()
        )
    else:
        text = "\n\n".join("\n".join("  ".join(f"{v: .9f}" for v in row) for row in T) for T in value)
    return [f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"]
