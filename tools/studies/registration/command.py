"""``python -m tools.studies registration``: from how far off each method of refinement still converges."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import Seed, Unit
from geomtact.cli.shell import print_table
from geomtact.cli.simulate import NoiseName
from geomtact.errors import InputError
from tools.studies.common import study_file, study_options

if TYPE_CHECKING:
    from geomtact.geometry.mesh import Mesh
    from geomtact.registration.surface import Surface
    from geomtact.sensing.sensor import Sensor

SCHEMA = "geomtact/registration/2"


def judge_registration(
    parts: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="OBJECT...",
            help="Objects, mesh files or bare shapes; the thesis's four and all shapes by default.",
            show_default=False,
        ),
    ] = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    touches: Annotated[int, typer.Option("--touches", min=1, help="How many touches of each object.")] = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    felt: study_options.Felt = study_options.FeltName.both,
    seed: Seed = 1,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
) -> None:
    """Judge registration: from how far off each method of refinement converges, all from the same starts.

    Prints success, errors and times of each method, and writes them and every trial to --out.
    """
    from geomtact.cli.several import units_of
    from geomtact.contact_space.build import choose_resolution
    from geomtact.contact_space.resolution import MAX_POSES
    from geomtact.contact_space.space import ContactSpace
    from geomtact.contact_space.touches import GEL_KINDS, random_touches
    from geomtact.evaluation import identity
    from geomtact.inference.mode_refiner import ModeRefiner
    from geomtact.json_values import plain
    from geomtact.registration.observability import Spread
    from geomtact.sensing.sensor import Sensor
    from geomtact.versions import versions
    from tools.studies.registration import study as registration
    from tools.studies.registration.peers import peers

    content = study_file.load(out, SCHEMA)
    if any("outcomes" not in part for part in content["parts"].values()):
        raise InputError(f"{out}: holds figures alone, no outcomes to go on with; give another file with --out")
    content.pop("figures", None)
    pressed, strength = Sensor.load(sensor), study_options.noise_named(noise)
    named = _named(parts)
    found = [_mesh(part, own, pressed) for part, own in zip(named, units_of(named, unit), strict=True)]
    for mesh in [mesh.with_symmetry() for mesh in found]:
        space = ContactSpace(mesh, pressed)
        resolution = choose_resolution(mesh, pressed, None, MAX_POSES)
        assert mesh.symmetry is not None
        directions = resolution.directions(mesh.symmetry, None)
        grid = registration.Grid(directions, resolution)
        surface = ModeRefiner(space).surface

        def methods(
            spread: Spread, space: ContactSpace = space, surface: Surface = surface
        ) -> dict[str, registration.Method]:
            return registration.own_methods(space, surface, spread) | peers(surface, spread)

        settings = identity(mesh, pressed) | {
            "touches": touches,
            "noise": {"name": noise.value, **asdict(strength)},
            "elastic": GEL_KINDS[felt],
            "seed": seed,
            "grid": resolution.to_json(),
            "methods": list(methods(grid.spread)),
            "success_mm": registration.SUCCESS_MM,
            "peers": versions("small_gicp", "probreg"),
        }

        def more(
            first: int, space: ContactSpace = space, methods: Any = methods, grid: registration.Grid = grid
        ) -> Iterator[Any]:
            pressed_at = random_touches(space, touches, seed, GEL_KINDS[felt], strength)
            return registration.trials(space, pressed_at, methods, grid, strength, seed, first=first)

        study_file.judged(out, content, settings, touches, "registering", more)
    trials = [registration.Trial(**t) for part in content["parts"].values() for some in part["outcomes"] for t in some]
    half_pixel = 0.5 * float(pressed.pixel_area(pressed.along(registration.MASK))) ** 0.5
    content["figures"] = plain(registration.summarise(trials, 1e3 * half_pixel))
    study_file.save(out, content)
    _print(content["figures"])
    if any(content["figures"]["success"].values()):
        study_file.plot(content, plot)


def parts_meant(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options, with the objects and shapes that are meant where none is named."""
    return {**options, "parts": _named(options["parts"])}


def _named(parts: list[str] | None) -> list[str]:
    from tools.studies.common.study import THESIS_PARTS
    from tools.studies.registration.shapes import SHAPES

    return parts or [*THESIS_PARTS, *SHAPES]


def _mesh(part: str, unit: str | None, sensor: Sensor) -> Mesh:
    from geomtact.geometry.mesh_file import load_mesh
    from tools.studies.registration.shapes import SHAPES, shape

    return shape(part) if part in SHAPES else load_mesh(part, unit, sensor=sensor)


def _print(figures: Mapping[str, Any]) -> None:
    share, length = study_file.percent, study_file.figure
    headings = ("method", "success", "converged", "error [mm]", "drift [mm]", "ms")
    rows = []
    for name, f in figures["methods"].items():
        lengths = [length(f["error_mm_median"]), length(f["drift_mm_median"])]
        rows.append([name, share(f["success"]), share(f["converged"]), *lengths, f"{f['ms_median']:.1f}"])
    typer.echo("Over all start errors; errors in observable directions, drift in the others")
    print_table(headings, rows, headings[1:])
    headings = ("method", "error [mm]", "of start's", "got worse", "in 90 %", "agreement")
    rows = []
    for name, f in figures["from_grid"].items():
        inside = None if f["coverage"] is None else f["coverage"]["0.9"]
        shares = [share(f["worse"]), share(inside), share(f["agreement"])]
        rows.append([name, length(f["error_mm_median"]), length(f["of_start"]), *shares])
    typer.echo("From poses of the grid; at 90 %: truths inside the 90 % region")
    print_table(headings, rows, headings[1:])
    names = list(figures["methods"])
    rows = [
        [kind, *(length(methods.get(name, {}).get("median_mm")) for name in names)]
        for kind, methods in figures["drift"].items()
    ]
    typer.echo("Median drift [mm] from poses of the grid")
    print_table(["contact", *names], rows, names)
    for cell in figures["lost"]:
        start = f"{cell['turn_deg']:g} degrees and {cell['shift_mm']:g} mm off"
        typer.echo(f"{cell['contact']}, {start}: {cell['to']} succeeds more often than filterreg")
