"""``geomtact prepare``: build and cache the contact index of an object on a sensor."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomtact.cli.apart import Jobs, Ray, do_all, everywhere, parts_of_tasks
from geomtact.cli.options import Approaches, CacheDir, MaxPoses, Mounting, ScorerName, SensorName, Unit, approach_from
from geomtact.cli.shell import progress_bar, tell
from geomtact.errors import UsageError

if TYPE_CHECKING:
    from geomtact.geometry.approach import Approach
    from geomtact.geometry.mesh import Mesh
    from geomtact.inference.localizer import Localizer
    from geomtact.sensing.sensor import Sensor

_MANY_WINDOWS = 10  # long sides of the window, from which on an object's unit is doubted


def prepare(
    objects: Annotated[
        list[str] | None,
        typer.Argument(metavar="OBJECT...", help="Objects (see 'geomtact objects') or mesh files."),
    ] = None,
    unit: Unit = None,
    sensor: SensorName = None,
    approach: Approaches = None,
    scorer: ScorerName = None,
    max_poses: MaxPoses = None,
    cache_dir: CacheDir = None,
    jobs: Jobs = None,
    ray: Ray = None,
) -> None:
    """Build and cache the contact index of an object on a sensor, so that 'localize' starts at once.

    Several objects are prepared in parallel, one on each core. Objects whose index is cached are skipped. The command
    lists at the end the objects that cannot be used.
    """
    import time

    from geomtact.cli.project import resolve

    values, sources = resolve({"object": objects[0] if objects else None, "unit": unit, "sensor": sensor})
    began = time.perf_counter()
    sides = approach_from(approach)
    if jobs is not None or ray is not None or (objects is not None and len(objects) > 1):
        if sides:
            raise UsageError("--approach needs exactly one object, without --jobs and --ray; leave it out, or give one")
        _prepare_all(objects, values, sources, scorer, max_poses, cache_dir, jobs, ray)
    else:
        localizer = open_localizer(values, sources, scorer, cache_dir, max_poses, approach=sides, given="OBJECT")
        for warning in localizer.mesh.warnings:
            tell(f"warning: {warning}")
        typer.echo(f"{localizer.mesh.name} on {localizer.sensor.name}: ready after {time.perf_counter() - began:.1f} s")


def _prepare_all(
    objects: list[str] | None,
    values: dict,
    sources: dict,
    scorer: str | None,
    max_poses: int | None,
    cache_dir: Path | None,
    jobs: int | None,
    ray: str | None,
) -> None:
    """Prepare several objects in parallel.

    Raises
    ------
    InputError
        Some of them cannot be used; the others are ready.
    """
    from geomtact.batch import prepare_part
    from geomtact.cli.project import require
    from geomtact.contact_space.resolution import MAX_POSES
    from geomtact.contact_space.store import DEFAULT_LIMIT, cache_entries, default_cache_dir
    from geomtact.geometry.catalogue import catalogue
    from geomtact.scoring.catalogue import DEFAULT_SCORER, check_name
    from geomtact.sensing.sensor import Sensor, bundled_sensors

    objects = objects or [require(values, "object", list(catalogue()), "a mesh file with --unit", "OBJECT")]
    gel = Sensor.load(require(values, "sensor", bundled_sensors(), "a TOML file"))
    for key, source in sources.items():
        tell(f"{key}: {values[key]} (from {source})")
    scorer = scorer or DEFAULT_SCORER
    check_name(scorer)
    _doubt_unit_of_first(objects, values["unit"], gel)
    # named, so that what is prepared first is not removed to make room for the last
    folder = (cache_dir or default_cache_dir()).absolute()
    how = (gel, everywhere(scorer), max_poses or MAX_POSES, folder)
    tasks = [(*part, *how) for part in parts_of_tasks(objects, values["unit"])]
    try:
        do_all(prepare_part, tasks, [f"{part} on {gel.name}" for part in objects], "prepared", jobs, ray)
    finally:
        size = sum(entry.size_bytes for entry in cache_entries(folder))
        if cache_dir is None and size > DEFAULT_LIMIT:
            tell(
                f"warning: the cache holds {size / 1e9:.0f} GB; the next single object prepared reduces it to "
                f"{DEFAULT_LIMIT / 1e9:.0f} GB. To keep all, give a folder by --cache-dir"
            )


def _doubt_unit_of_first(parts: list[str], unit: str | None, sensor: Sensor) -> None:
    """As :func:`_doubt_unit`, of the first object that states no unit: all of those share the given one."""
    from geomtact.errors import GeomtactError
    from geomtact.geometry.mesh_file import load_mesh, states_unit

    first = next((part for part in parts if not states_unit(part)), None)
    if first is not None:
        with contextlib.suppress(GeomtactError, OSError):  # its task reports them
            _doubt_unit(load_mesh(first, unit, sensor=sensor), sensor)


def _doubt_unit(mesh: Mesh, sensor: Sensor) -> None:
    """Warn of an object so large that its unit may be wrong."""
    windows = mesh.diameter / (2 * sensor.half_window.max())
    if windows > _MANY_WINDOWS:
        tell(
            f"warning: read in {mesh.unit}, {mesh.name} is {1e3 * mesh.diameter:.0f} mm across, {windows:.0f} windows of "
            f"sensor {sensor.name!r}; if its size is another, give its --unit; so large an object takes long to prepare"
        )


def open_localizer(
    values: dict,
    sources: dict,
    scorer: str | None,
    cache_dir: Path | None,
    max_poses: int | None = None,
    prior: Path | None = None,
    frame: str = "sensor",
    approach: Approach | None = None,
    given: str | None = None,
    mounting: Mounting | None = None,
) -> Localizer:
    """The localizer for resolved options, with a progress bar where its index has to be built first.

    A ``prior`` of another object, or not in ``frame``, is refused before that. ``approach`` is as of ``Localizer.prepare``,
    ``given`` how the object is named on the command line, if not by --object; the camera's ``mounting`` as that says.
    """
    from geomtact.cli.project import require
    from geomtact.geometry.catalogue import catalogue
    from geomtact.sensing.sensor import Sensor, bundled_sensors

    object_name = require(values, "object", list(catalogue()), "a mesh file with --unit", given)
    sensor = require(values, "sensor", bundled_sensors(), "a TOML file")
    for key, source in sources.items():
        tell(f"{key}: {values[key]} (from {source})")

    from geomtact.contact_space.resolution import MAX_POSES
    from geomtact.geometry.mesh_file import load_mesh
    from geomtact.inference.files import heading
    from geomtact.inference.localizer import Localizer
    from geomtact.inference.prior import check_same
    from geomtact.scoring.catalogue import DEFAULT_SCORER, check_name

    scorer = scorer or DEFAULT_SCORER
    check_name(scorer)  # before minutes go into an index
    gel = Sensor.load(sensor) if mounting is None else mounting.of(sensor)
    mesh = load_mesh(object_name, values["unit"], sensor=gel)
    if prior is not None:
        check_same(heading(prior), mesh, frame)
    _doubt_unit(mesh, gel)
    with progress_bar("preparing") as progress:
        return Localizer.prepare(
            mesh,
            None,
            gel,
            approach,
            scorer=scorer,
            max_poses=max_poses or MAX_POSES,
            cache_dir=cache_dir,
            progress=progress,
        )
