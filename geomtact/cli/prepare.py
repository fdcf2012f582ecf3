"""``geomtact prepare``: build and cache the contact index of an object on a sensor."""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING

import typer

from geomtact.cli import options
from geomtact.cli.project import required, resolve
from geomtact.cli.request import Request, warn_of_size
from geomtact.cli.several import Jobs, Ray, do_all, everywhere, objects_with_units
from geomtact.cli.shell import to_stderr
from geomtact.errors import UsageError

if TYPE_CHECKING:
    from geomtact.sensing.sensor import Sensor


def prepare(
    objects: options.Objects = None,
    unit: options.Unit = None,
    sensor: options.SensorName = None,
    approach: options.Approaches = None,
    scorer: options.ScorerName = None,
    max_poses: options.MaxPoses = None,
    cache_dir: options.CacheDir = None,
    jobs: Jobs = None,
    ray: Ray = None,
) -> None:
    """Build and cache the contact index of an object on a sensor, so that 'localize' starts at once.

    Several objects are prepared in parallel, one on each core. Objects whose index is cached are skipped. The command
    lists at the end the objects that cannot be used.
    """
    import time

    given = {"object": objects[0] if objects else None, "unit": unit, "sensor": sensor}
    values, sources = resolve(given)
    began = time.perf_counter()
    sides = options.approach_from(approach)
    request = Request(values, sources, approach=sides, scorer=scorer, max_poses=max_poses, cache_dir=cache_dir)
    if jobs is not None or ray is not None or (objects is not None and len(objects) > 1):
        if sides:
            raise UsageError("--approach needs exactly one object, without --jobs and --ray; leave it out, or give one")
        _prepare_all(objects, request, jobs, ray)
    else:
        localizer = request.open(argument="OBJECT")
        for warning in localizer.mesh.warnings:
            to_stderr(f"warning: {warning}")
        typer.echo(f"{localizer.mesh.name} on {localizer.sensor.name}: ready after {time.perf_counter() - began:.1f} s")
        grid = localizer.index.resolution
        typer.echo(f"grid: {math.degrees(grid.turn_step):.1f} degrees, {1e3 * grid.step:.2f} mm apart")


def _prepare_all(objects: list[str] | None, request: Request, jobs: int | None, ray: str | None) -> None:
    """Prepare several objects in parallel.

    Raises
    ------
    InputError
        Some of them cannot be used; the others are ready.
    """
    from geomtact.batch import prepare_part
    from geomtact.contact_space.resolution import MAX_POSES
    from geomtact.contact_space.store import DEFAULT_LIMIT, cache_entries, default_cache_dir
    from geomtact.scoring.catalogue import DEFAULT_SCORER, check_name
    from geomtact.sensing.sensor import Sensor

    first, sensor = required(request.values, "OBJECT")
    objects, unit, gel = objects or [first], request.values["unit"], Sensor.load(sensor)
    request.announce()
    scorer = request.scorer or DEFAULT_SCORER
    check_name(scorer)
    _warn_of_first_size(objects, unit, gel)
    # named, so that what is prepared first is not removed to make room for the last
    folder = (request.cache_dir or default_cache_dir()).absolute()
    how = (gel, everywhere(scorer), request.max_poses or MAX_POSES, folder)
    tasks = [(*part, *how) for part in objects_with_units(objects, unit)]
    try:
        do_all(prepare_part, tasks, [f"{part} on {gel.name}" for part in objects], "prepared", jobs, ray)
    finally:
        size = sum(entry.size_bytes for entry in cache_entries(folder))
        if request.cache_dir is None and size > DEFAULT_LIMIT:
            to_stderr(
                f"warning: the cache holds {size / 1e9:.0f} GB; the next single object prepared reduces it to "
                f"{DEFAULT_LIMIT / 1e9:.0f} GB. To keep all, give a folder by --cache-dir"
            )


def _warn_of_first_size(parts: list[str], unit: str | None, sensor: Sensor) -> None:
    """As :func:`warn_of_size`, of the first object that states no unit: all of those share the given one."""
    from geomtact.errors import GeomtactError
    from geomtact.geometry.mesh_file import load_mesh, states_unit

    first = next((part for part in parts if not states_unit(part)), None)
    if first is not None:
        with contextlib.suppress(GeomtactError, OSError):  # its task reports them
            warn_of_size(load_mesh(first, unit, sensor=sensor), sensor)
