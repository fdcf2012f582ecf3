"""``report.html``: one file with everything in it, readable without a network, in light and in dark."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import Any

from geomtact.report.summary import HEADINGS, percent

STYLE = """
:root { color-scheme: light dark; --text: #1b1f24; --back: #ffffff; --line: #d0d7de; --soft: #f6f8fa;
        --warn: #8a4b00; --warn-back: #fff3e0; }
@media (prefers-color-scheme: dark) { :root { --text: #e6edf3; --back: #0d1117; --line: #30363d; --soft: #161b22;
        --warn: #ffc680; --warn-back: #2d1f0a; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--text); background: var(--back); max-width: 72rem;
       margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
img { max-width: 100%; background: #ffffff; border: 1px solid var(--line); border-radius: 6px; }
.table { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line); white-space: nowrap; }
td:last-child { white-space: normal; min-width: 14rem; }
.warning { color: var(--warn); background: var(--warn-back); border-left: 4px solid; padding: .5rem .8rem; margin: .6rem 0; }
details { margin: 1rem 0; } summary { cursor: pointer; }
#scene canvas { width: 100%; height: min(60vh, 34rem); border: 1px solid var(--line); border-radius: 6px; touch-action: none; }
#scene button { font: inherit; color: inherit; background: var(--soft); border: 1px solid var(--line); border-radius: 6px;
                padding: .2rem .7rem; margin: 0 .4rem .5rem 0; cursor: pointer; }
#scene button[aria-selected=true] { color: #ffffff; background: #0072b2; border-color: #0072b2; }
#scene :focus-visible { outline: 3px solid #e69f00; }
pre { background: var(--soft); padding: .8rem; overflow-x: auto; font-size: .85rem; border-radius: 6px; }
"""

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
    for title, entries in (
        ("Settings", content["settings"]),
        ("Timing [ms]", timing),
        ("Versions", content["versions"]),
    ):
        parts += _folded(title, entries)
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{name} on {sensor}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{STYLE}</style>\n</head>\n'
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(h)}</th>" for h in headings)
    lines = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f'<div class="table"><table>\n<tr>{head}</tr>\n' + "\n".join(lines) + "\n</table></div>"


def _turnable(content: dict[str, Any], probabilities: Sequence[float]) -> list[str]:
    tabs = [f'<button role="tab" type="button">mode {k}: {percent(p)}</button>' for k, p in enumerate(probabilities, 1)]
    script = files("geomtact.report").joinpath("turnable.js").read_text("utf-8")
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
        f"<script>\n{script}</script>",
    ]


def _picture(title: str, description: str, png: bytes | None) -> list[str]:
    if png is None:
        return []
    data = base64.b64encode(png).decode("ascii")
    return [f"<h2>{escape(title)}</h2>", f'<img alt="{escape(description)}" src="data:image/png;base64,{data}">']


def _folded(title: str, value: Any) -> list[str]:
    if not value:
        return []
    if isinstance(value, dict):
        text = "\n".join(
            f"{key}: {entry if isinstance(entry, str) else json.dumps(entry)}" for key, entry in value.items()
        )
    else:
        text = "\n\n".join("\n".join("  ".join(f"{v: .9f}" for v in row) for row in T) for T in value)
    return [f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"]
