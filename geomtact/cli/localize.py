"""``geomtact localize``: from one image to the distribution of the part's pose."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from geomtact.cli.library import CacheDir
from geomtact.cli.prepare import MaxPoses, ScorerName, SensorName, Unit, open_localizer
from geomtact.cli.shell import NO_CONTACT, check_folder, print_table, tell
from geomtact.errors import InputError, UsageError, nearest_name

MODES = 5


class Kind(StrEnum):
    auto = "auto"
    mask = "mask"
    height = "height"
    reading = "reading"


class Effort(StrEnum):
    fast = "fast"
    balanced = "balanced"
    exact = "exact"


def localize(
    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="IMAGE...",
            help="Contact mask, height map or RGB reading; several of them with --sensor-poses.",
            show_default=False,
        ),
    ],
    object_name: Annotated[
        str | None, typer.Option("--object", help="Part (see 'geomtact objects') or mesh file.")
    ] = None,
    unit: Unit = None,
    sensor: SensorName = None,
    kind: Annotated[str, typer.Option(metavar="|".join(Kind), help="What the image is.")] = Kind.auto.value,
    background: Annotated[Path | None, typer.Option(help="Image of the untouched sensor, for readings.")] = None,
    sensor_poses: Annotated[
        Path | None,
        typer.Option(
            help="JSON of where each sensor is in the world: T_world_sensor, a 4x4 for each image, in metres."
        ),
    ] = None,
    prior: Annotated[Path | None, typer.Option(help="posterior.npz of what is known before.")] = None,
    effort: Annotated[
        str | None,
        typer.Option(metavar="|".join(Effort), help="How much to compute; balanced by default.", show_default=False),
    ] = None,
    scorer: ScorerName = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for result.json, posterior.npz, report.html and report.png.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print result.json, and nothing else, to standard output.")
    ] = False,
    max_poses: MaxPoses = None,
    cache_dir: CacheDir = None,
) -> None:
    """Localize a part from one image, or from those of several sensors: print the most probable poses and write a report.

    What is not given is taken from the nearest geomtact.toml (this folder or above), then from the image's metadata.
    Exit status: 0 done, 2 usage error, 3 bad input, 4 no contact in the image.
    """
    import time
    from dataclasses import replace

    from geomtact.cli.project import resolve
    from geomtact.cli.sensor_poses import read_sensor_poses
    from geomtact.sensing.reading import read_metadata, read_observation

    given = {
        "object": object_name,
        "unit": unit,
        "sensor": sensor,
        "background": None if background is None else str(background),
        "effort": effort,
    }
    check_folder(out)
    if prior is not None and not prior.is_file():
        raise InputError(f"--prior {prior}: no such file; give a posterior.npz")
    for image in images:
        if image.is_dir():
            raise InputError(
                f"{image}: is a folder; give the images in it, or follow them as a sequence with 'geomtact track'"
            )
    placed = read_sensor_poses(sensor_poses, len(images)) if sensor_poses is not None else None
    if placed is None and len(images) > 1:
        raise UsageError(f"{len(images)} images need --sensor-poses FILE.json; or localize them one at a time")
    metadata = read_metadata(images[0])
    values, sources = resolve(given, metadata)
    _check_name("kind", kind, Kind)
    chosen = values["effort"] or Effort.balanced.value
    _check_name("effort", chosen, Effort, sources.get("effort"))

    began = time.perf_counter()
    gels = placed.sensor if placed is not None and placed.sensor is not None else [values["sensor"]] * len(images)
    for image, gel in zip(images, gels, strict=True):
        if gel is not None:
            # a bad image is told before minutes go into an index
            read_observation(image, gel, kind, values["background"])
    opened = {
        gel: open_localizer({**values, "sensor": gel}, sources, scorer, cache_dir, max_poses)
        for gel in dict.fromkeys(gels)
    }
    made_of = metadata.get("geomtact:object")
    if made_of and values["object"] and Path(made_of).stem != Path(values["object"]).stem:
        tell(f"{images[0]}: was made of {made_of}, as its metadata says, and is localized on {values['object']}")
    localizer = opened[gels[0]]
    if len(opened) > 1:
        localizer = replace(localizer, others=tuple(opened[gel] for gel in gels[1:]))
    prepared = time.perf_counter()
    posterior = localizer.localize(
        [str(image) for image in images],
        kind=kind,
        background=values["background"],
        T_world_sensor=None if placed is None else placed.T_world_sensor,
        prior=prior,
        effort=chosen,
        seed=seed,
        rig=None if placed is None else placed.rig,
    )
    localized = time.perf_counter()
    modes = posterior.modes(MODES)
    for warning in posterior.warnings:
        tell(f"warning: {warning}")

    settings = {
        "image": str(images[0]) if len(images) == 1 else [str(image) for image in images],
        "kind": kind,
        "prior": prior and str(prior),
        **values,
        "taken_from": sources,
        "cache_dir": cache_dir and str(cache_dir),
    }
    timing = {"prepare": 1e3 * (prepared - began), "modes": 1e3 * (time.perf_counter() - localized)}
    if out is not None:
        from geomtact.report.write import write_all

        content = write_all(out, posterior, modes, localizer.simulate, settings, timing)
    elif as_json:
        from geomtact.report.result import result

        content = result(posterior, modes, settings, timing)
    if as_json:
        from geomtact.report.result import to_text

        typer.echo(to_text(content), nl=False)
    else:
        _print(posterior, modes, out)
    if not posterior.contact:
        where = "the image" if len(images) == 1 else f"any of the {len(images)} images"
        blank = posterior.observation.kind == "mask"
        advice = "a mask's contact is what is not 0" if blank else "give a --background, or say what it is with --kind"
        tell(f"no contact found in {where}; {advice}")
        raise typer.Exit(NO_CONTACT)


def _check_name(option: str, name: str, known: type[StrEnum], file: str | None = None) -> None:
    """Refuse an unknown name, which the command line gave or a ``geomtact.toml``.

    Raises
    ------
    UsageError, InputError
    """
    names = [k.value for k in known]
    if name not in names:
        what = f"no {option} named {name!r}{nearest_name(name, names)}"
        raise InputError(f"{file}: {what}") if file else UsageError(f"--{option}: {what}")


def _print(posterior, modes, out: Path | None) -> None:
    from geomtact.report.summary import HEADINGS, caution, facts, summaries_of, table

    typer.echo(f"{posterior.mesh.name} on {posterior.sensor.name}, {posterior.frame} frame")
    if modes:
        right = ["mode", "probability", "±"]
        summaries = summaries_of(posterior, modes)
        print_table(HEADINGS, table(summaries), right)
        for line in (*facts(posterior), *caution(summaries)):
            typer.echo(line)
    typer.echo(
        f"written: {out}/report.html and .png, result.json, posterior.npz" if out else "for a report, give --out DIR"
    )
