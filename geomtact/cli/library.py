"""``geomtact sensors``, ``objects`` and ``cache``: lists of what is bundled and cached."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import typer

from geomtact.cli.options import CacheDir
from geomtact.cli.shell import print_table, to_stderr
from geomtact.errors import UsageError


def sensors() -> None:
    """List the bundled sensors."""
    from geomtact.sensing.sensor import Sensor, bundled_sensors

    rows = []
    for name in bundled_sensors():
        s = Sensor.load(name)
        width, height = 2e3 * s.half_window
        optics = f"{1e3 * s.camera_distance:.3g} mm" if s.camera_distance else "orthographic"
        shape = f"radius {1e3 * s.membrane_radius:.3g} mm" if s.membrane_radius else "flat"
        pixels = f"{s.image_size_px[0]} x {s.image_size_px[1]}"
        rows.append([name, pixels, f"{width:.1f} x {height:.1f}", f"{1e3 * s.max_penetration:.1f}", optics, shape])
    print_table(["sensor", "pixels", "window [mm]", "depth [mm]", "camera", "membrane"], rows)


def objects() -> None:
    """List the bundled objects."""
    import numpy as np

    from geomtact.geometry.catalogue import catalogue
    from geomtact.geometry.mesh_file import load_mesh

    rows = []
    for name, entry in catalogue().items():
        size = " x ".join(f"{1e3 * side:.0f}" for side in np.ptp(load_mesh(name).vertices, axis=0))
        symmetry = entry.symmetry.kind
        if symmetry == "discrete":
            symmetry = f"{len(entry.symmetry.elements)}-fold"
        rows.append([name, entry.unit, size, symmetry, entry.licence, entry.description])
    print_table(["object", "unit", "size [mm]", "symmetry", "licence", "description"], rows)


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all cached contact indexes.")] = False,
    limit_gb: Annotated[
        float | None,
        typer.Option("--limit-gb", min=0, help="Remove the least recently used indexes until this size is left."),
    ] = None,
    remove: Annotated[
        list[str] | None,
        typer.Option(
            "--remove", metavar="OBJECT|KEY", help="Remove all of an object, or one by its key. May be repeated."
        ),
    ] = None,
    cache_dir: CacheDir = None,
) -> None:
    """List the cached contact indexes; remove some or all of them."""
    import time

    from geomtact.contact_space import store

    if clear + (limit_gb is not None) + bool(remove) > 1:
        raise UsageError("--clear, --limit-gb and --remove exclude each other; give one of them")
    folder = cache_dir or store.default_cache_dir()
    removed = None
    if clear:
        removed = store.clear_cache(folder)
    elif limit_gb is not None:
        removed = store.bound_cache(int(min(1e9 * limit_gb, 2**62)), folder)
    elif remove:
        removed = store.remove_from_cache(remove, folder)
    if removed is not None:
        to_stderr(f"removed {_count(len(removed))}, {sum(e.size_bytes for e in removed) / 1e6:.0f} MB")
    entries = store.cache_entries(folder)
    rows = []
    for e in entries:
        size, used = f"{e.size_bytes / 1e6:.0f}", _when(time.time() - e.last_used)
        rows.append([e.key[:12], e.object, e.sensor, _sides(e.approach), f"{e.poses:,}", size, used])
    print_table(["key", "object", "sensor", "approach", "poses", "MB", "last used"], rows, right=["poses", "MB"])
    typer.echo(f"{_count(len(entries))}, {sum(e.size_bytes for e in entries) / 1e6:.0f} MB in {folder}")


def _sides(approach: Sequence[tuple[Sequence[float], float]] | None) -> str:
    """An approach as ``--approach`` takes it."""
    return " ".join(
        ",".join(f"{x + 0.0:.2g}" for x in direction) + (f":{math.degrees(angle):.3g}" if angle else "")
        for direction, angle in approach or []
    )


def _when(seconds: float) -> str:
    for unit, length in (("day", 86400), ("hour", 3600), ("minute", 60)):
        n = int(seconds // length)
        if n:
            return f"{n} {unit}{'s' if n > 1 else ''} ago"
    return "just now"


def _count(n: int) -> str:
    return f"{n} index" if n == 1 else f"{n} indexes"
