"""A picture of a mesh before and after, faces coloured by how far they lie from the input."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
from meshprep.proof import Proof
from meshprep.repair import Work
from meshprep.surface import Array, Surface

_PIXELS = 360
_VIEWS = (np.array([0.6, -0.75, 0.5]), np.array([-0.6, 0.75, -0.5]))  # towards the viewer
_PART, _OPEN, _FILLED = np.array([0.72, 0.75, 0.80]), "#D55E00", np.array([0.0, 0.62, 0.45])


def draw(name: str, unit: str, before: Surface, work: Work, proof: Proof, bound: float) -> bytes:
    """A PNG: two sides of the mesh, before with its open edges, and after by deviation; filled holes in green."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    after = work.surface
    colours = mpl.colormaps["YlOrRd"](np.clip(proof.deviation / bound, 0, 1))[:, :3]
    colours[proof.deviation < 1e-3 * bound] = _PART
    if len(work.patches):
        patch = {tuple(np.round(c, 12)) for c in work.patches.mean(1).tolist()}
        colours[[tuple(np.round(c, 12)) in patch for c in after.corners.mean(1).tolist()]] = _FILLED
    figure = Figure(figsize=(9, 8.6), dpi=90, layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(name, parse_math=False)
    axes = figure.subplots(2, 2)
    for row, towards in zip(axes, _VIEWS, strict=True):
        image, extent, plane = _shaded(before, lambda _, face: np.tile(_PART, (len(face), 1)), towards, after)
        row[0].imshow(image, extent=extent)
        bare = before.vertices[before.half_edges[0][before.open_half_edges[:4000]]] @ plane.T
        for line in bare:
            row[0].plot(*line.T, color=_OPEN, lw=1)
        row[1].imshow(_shaded(after, lambda _, face: colours[face], towards, after)[0], extent=extent)
        for each in row:
            each.set_xlabel(f"[{unit}]")
            each.tick_params(labelsize=8)
    axes[0, 0].set_title(f"before: {len(before.faces):,} faces, {before.open_edges:,} open edges (red)")
    axes[0, 1].set_title(f"after: {len(after.faces):,} faces, {len(work.holes)} holes filled (green)")
    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(0, bound), "YlOrRd")
    figure.colorbar(scale, ax=axes, shrink=0.6, label=f"distance from the input [{unit}]", extend="max")
    out = io.BytesIO()
    canvas.print_png(out)
    return out.getvalue()


def draw_values(
    name: str, unit: str, surface: Surface, value: Callable[[Array], Array], low: float, high: float, words: str
) -> bytes:
    """A PNG: two sides of a mesh, coloured by the ``value`` (n,) of its points (n, 3), from ``low`` to ``high``."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(low, high), "viridis")
    figure = Figure(figsize=(9, 4.4), dpi=100, layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(name, parse_math=False)
    axes = figure.subplots(1, 2)
    for each, towards in zip(axes, _VIEWS, strict=True):
        image, extent, _ = _shaded(surface, lambda point, _: scale.to_rgba(value(point))[:, :3], towards, surface)
        each.imshow(image, extent=extent)
        each.set_xlabel(f"[{unit}]")
    figure.colorbar(scale, ax=axes, shrink=0.8, label=words)
    out = io.BytesIO()
    canvas.print_png(out)
    return out.getvalue()


def _shaded(
    surface: Surface, colour: Callable[[Array, Array], Array], towards: Array, frame: Surface
) -> tuple[Array, tuple, Array]:
    """``surface`` seen along parallel rays (n, n, 3), the picture's extent, and the axes (2, 3) right and up.

    ``colour`` gives that (m, 3) of points (m, 3) on faces (m,).
    """
    back = towards / np.linalg.norm(towards)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    plane = np.stack([right, np.cross(back, right)])
    seen = frame.vertices @ plane.T
    middle, half = 0.5 * (seen.max(0) + seen.min(0)), 0.53 * float(np.ptp(seen, axis=0).max())
    steps = (np.arange(_PIXELS) + 0.5) / _PIXELS * 2 - 1
    u, v = np.meshgrid(middle[0] + half * steps, middle[1] - half * steps)
    origin = (
        u.ravel()[:, None] * plane[0] + v.ravel()[:, None] * plane[1] + (frame.middle @ back + 2 * frame.size) * back
    )
    scene, (centre, scale) = surface.scene
    rays = np.concatenate([(origin - centre) / scale, np.tile(-back, (len(origin), 1))], 1).astype(np.float32)
    hit = scene.cast_rays(rays)
    face = hit["primitive_ids"].numpy().astype(np.int64)
    found = np.isfinite(hit["t_hit"].numpy())
    normal = surface.crosses / np.maximum(np.linalg.norm(surface.crosses, axis=1, keepdims=True), 1e-300)
    light = 0.4 + 0.6 * np.abs(normal @ back)
    image = np.ones((len(origin), 3))
    where = origin - (scale * hit["t_hit"].numpy()[:, None]) * back
    image[found] = light[face[found], None] * colour(where[found], face[found])
    extent = (middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half)
    return image.reshape(_PIXELS, _PIXELS, 3), extent, plane
