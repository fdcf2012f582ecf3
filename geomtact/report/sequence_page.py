"""A sequence as one HTML file that plays it, readable without a network, in light and in dark."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geomtact.json_values import plain
from geomtact.report.canvas import OBSERVED, SIMULATED, png_of, rgb, to_pixels
from geomtact.report.page import asset, document
from geomtact.report.summary import percent
from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact

if TYPE_CHECKING:
    from geomtact.inference.posterior import Posterior

_WIDTH = 320  # px of the pictures, at most
_CURVE = 640, 160  # width and height of the entropy's curve, in units of its own


def sequence_frame(
    posterior: Posterior, line: Mapping[str, Any], simulate: Callable[[Array], Contact]
) -> dict[str, Any]:
    """What the page shows of one frame.

    Parameters
    ----------
    posterior : after the frame
    line : what is printed of it, with ``T`` (4, 4) of the most probable pose or None
    simulate : the contact at a pose T_sensor_object, without noise
    """
    out: dict[str, Any] = {key: line[key] for key in ("frame", "entropy_nats", "surprise_nats", "warnings")}
    out |= {"image": None, "contact": None, "summary": _summary(line)}
    for observation in posterior.observations[:1]:
        out["image"] = _png(observation.image)
        mask = observation.contact.mask
        drawn = np.ones((*mask.shape, 3))
        if line["T"] is not None:
            drawn[simulate(inverse(posterior.T_frame_sensor) @ line["T"]).mask] = rgb(SIMULATED)
        drawn[_border(mask)] = rgb(OBSERVED)
        out["contact"] = _png(drawn)
    return out


def sequence_page(name: str, sensor: str, frames: Sequence[Mapping[str, Any]]) -> str:
    """The text of the page that plays ``frames``, as of :func:`sequence_frame`."""
    curve, places = _curve([frame["entropy_nats"] for frame in frames])
    data = json.dumps(plain([{**frame, "x": x} for frame, x in zip(frames, places, strict=True)]), allow_nan=False)
    title = escape(f"{name} on {sensor}: {len(frames)} frames")
    body = f"""<h1>{title}</h1>
<div class="player"><button id="play">Play</button>
<input id="frame" type="range" min="0" max="{len(frames) - 1}" value="0" aria-label="frame"><span id="number"></span></div>
<p id="summary"></p>
<div id="warnings"></div>
<div class="pictures">
<figure><img id="image" alt="the image"><figcaption>The image</figcaption></figure>
<figure><img id="contact" alt="contact simulated at the most probable pose, and the observed outline">
<figcaption><span style="color: {SIMULATED}">&#9632;</span> contact simulated at the most probable pose,
<span style="color: {OBSERVED}">&#9632;</span> observed outline</figcaption></figure>
</div>
<h2>Information gain by frame</h2>
{curve}"""
    # a closing tag inside a string would end the script
    script = f"const FRAMES = {data.replace('</', '<' + chr(92) + '/')};\n{asset('sequence_page.js')}"
    return document(title, f"{body}\n<script>\n{script}</script>", "\n" + asset("sequence_page.css"))


def _summary(line: Mapping[str, Any]) -> str:
    if line["T"] is None:
        return "No contact."
    where = ", ".join(f"{x:.1f}" for x in line["translation_mm"])
    gain = f"Information gain {max(0.0, -line['entropy_nats']):.1f} nats. Mode 1 holds {percent(line['probability'])}"
    surprise = line["surprise_nats"]
    expected = f" The earlier frames change the frame's log likelihood by {surprise:+.1f} nats." if surprise else ""
    return f"{gain}, with the object's origin at ({where}) mm.{expected}"


def _curve(entropy: Sequence[float | None]) -> tuple[str, list[float]]:
    """An SVG of the information gain of each frame, and where along x each frame is."""
    wide, high = _CURVE
    gain = [None if e is None else max(0.0, -e) for e in entropy]
    top = max([1.0, *(k for k in gain if k is not None)])
    x = np.linspace(0, wide, len(gain)) if len(gain) > 1 else np.array([wide / 2])
    pieces, pen = [], "M"
    for place, k in zip(x, gain, strict=True):
        if k is not None:
            pieces.append(f"{pen}{place:.1f},{high * (1 - k / top):.1f}")
        pen = "M" if k is None else "L"
    dots = "".join(
        f'<circle cx="{place:.1f}" cy="{high * (1 - k / top):.1f}" r="2.5" fill="{SIMULATED}"/>'
        for place, k in zip(x, gain, strict=True)
        if k is not None
    )
    svg = (
        f'<svg viewBox="-40 -20 {wide + 56} {high + 52}" role="img" aria-label="information gain of each frame">'
        f'<path d="M0,0V{high}H{wide}" fill="none" stroke="var(--line)"/>'
        f'<path d="{"".join(pieces)}" fill="none" stroke="{SIMULATED}" stroke-width="2"/>{dots}'
        f'<line id="mark" y1="0" y2="{high}" x1="0" x2="0" stroke="{OBSERVED}" stroke-width="1.5"/>'
        f'<text x="-6" y="4" text-anchor="end">{top:.1f}</text><text x="-6" y="{high + 4}" text-anchor="end">0</text>'
        f'<text x="0" y="{high + 16}">1</text><text x="{wide}" y="{high + 16}" text-anchor="end">{len(gain)}</text>'
        f'<text x="{wide / 2}" y="{high + 28}" text-anchor="middle">frame</text>'
        '<text x="0" y="-4">information gain [nats]</text></svg>'
    )
    return svg, [round(float(place), 1) for place in x]


def _border(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels of a contact (H, W) that touch what is not."""
    import cv2

    border = mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return np.asarray(cv2.dilate(border.astype(np.uint8), np.ones((2, 2), np.uint8)), bool)


def _png(image: NDArray[Any]) -> str:
    """An image as read, or a picture (H, W, 3) in 0..1, made small enough, as base64."""
    from PIL import Image

    picture = Image.fromarray(to_pixels(image))
    picture.thumbnail((_WIDTH, _WIDTH))
    return base64.b64encode(png_of(np.asarray(picture), optimize=True)).decode("ascii")
