"""``geomtact localize``: from one image, or one per sensor, to the distribution of the object's pose."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli import options
from geomtact.cli.request import Request
from geomtact.cli.shell import NO_CONTACT, check_folder, to_stderr
from geomtact.errors import InputError, UsageError

if TYPE_CHECKING:
    from geomtact.cli.sensor_poses import SensorPoses
    from geomtact.identification import Identification
    from geomtact.localizer import Localizer
    from geomtact.sensing.image_file import ImageFile


class Report(StrEnum):
    html = "html"
    png = "png"
    none = "none"


def localize(
    images: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="IMAGE...",
            help="Contact mask, depth map or tactile image; one per sensor with --sensor-poses; a folder with --watch.",
            show_default=False,
        ),
    ] = None,
    object_name: Annotated[
        str | None,
        typer.Option(
            "--object",
            help="Object (see 'geomtact objects') or mesh file. To identify one of several: names with commas, or a folder.",
        ),
    ] = None,
    unit: options.Unit = None,
    sensor: options.SensorName = None,
    kind: options.KindName = options.Kind.auto.value,
    background: Annotated[
        list[Path] | None,
        typer.Option(help="Tactile image of the untouched sensor. Repeat the option to give one for each image."),
    ] = None,
    sensor_poses: Annotated[
        Path | None,
        typer.Option(
            help="Sensor extrinsics: JSON with T_world_sensor, a 4x4 matrix for each image, in metres. See below."
        ),
    ] = None,
    prior: Annotated[Path | None, typer.Option(help="Prior: posterior.npz of earlier touches, or its folder.")] = None,
    approach: options.Approaches = None,
    effort: options.EffortName = None,
    scorer: options.ScorerName = None,
    seed: options.Seed = 0,
    rotate: options.Rotate = None,
    mirror: options.Mirror = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="Camera to use instead of images: its number, device or URL. Prints one JSON line per image."
        ),
    ] = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="The same for the newest image of a folder, given as IMAGE.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for result.json, posterior.npz, report.html and report.png.")
    ] = None,
    report: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(Report), help="Report to write into --out; html and png by default.", show_default=False
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print only result.json to standard output.")] = False,
    max_poses: options.MaxPoses = None,
    cache_dir: options.CacheDir = None,
) -> None:
    """Localize an object from one image, or one image per sensor: print the most probable poses and write a report.

    Options that you leave out come from the nearest geomtact.toml (this folder or above), then from the image's metadata.

    --camera and --watch localize the newest image, again and again, until Ctrl-C. Images in between are skipped. Without
    --background, the first image without contact serves as background.

    Exit status: 0 done, 2 usage error, 3 bad input, 4 no contact in the image.
    """
    from geomtact.cli.live import check_live, follow
    from geomtact.cli.outcome import give, without_contact
    from geomtact.cli.sensor_poses import read_sensor_poses
    from geomtact.sensing.image_file import ImageFile

    check_folder(out)
    reports = _reports(report, out)
    images = images or []
    live = camera is not None or watch
    if live:
        unsuited = {"--out": out, "--sensor-poses": sensor_poses, "--json": as_json or None}
        check_live(images, camera, watch, [name for name, value in unsuited.items() if value is not None])
    else:
        _check_images(images, sensor_poses)
    placed = read_sensor_poses(sensor_poses, len(images)) if sensor_poses is not None else None
    files = [] if live else [ImageFile.read(image) for image in images]
    metadata = [file.metadata for file in files]
    if background and len(background) not in (1, len(images)):
        raise UsageError(f"--background: expected one, or one for each of {len(images)} images, got {len(background)}")
    first = background[0] if background else None
    request = Request.of(
        {"object": object_name, "unit": unit, "sensor": sensor, "background": first, "effort": effort},
        metadata[0] if metadata else {},
        kind,
        prior,
        approach=options.approach_from(approach),
        scorer=scorer,
        seed=seed,
        max_poses=max_poses,
        cache_dir=cache_dir,
        mounting=options.Mounting(rotate, mirror),
    )
    objects = _objects(request, live)
    if live:
        if not follow(request, images, camera):
            raise typer.Exit(NO_CONTACT)
        return
    sensors = placed.sensor if placed is not None and placed.sensor else [request.values["sensor"]] * len(images)
    backgrounds = [request.values["background"]] * len(images)
    if background and len(background) > 1:
        backgrounds = [str(each) for each in background]
    found, timing_ms = _identified(request, files, sensors, backgrounds, objects, placed)
    for image, made, used in zip(images, metadata, sensors, strict=True):
        _warn_of_metadata(image, made, objects[0] if len(objects) == 1 else None, used)
    if len(objects) > 1 and found.is_unknown:
        to_stderr("warning: the contact is out-of-distribution for every candidate: it may be of another object")
    for warning in found.posterior.warnings:
        to_stderr(f"warning: {warning}")
    give(request, images, found, timing_ms, out, reports, as_json)
    if not found.posterior.contact:
        to_stderr(without_contact(request, len(images), found.posterior.provenance.views[0].kind))
        raise typer.Exit(NO_CONTACT)


def _objects(request: Request, live: bool) -> list[str | None]:
    """The objects to tell apart; a single one is put into the request."""
    from geomtact.cli.several import objects_of

    objects = objects_of(request.values["object"])
    if len(objects) == 1:
        request.values["object"] = objects[0]
    elif live or request.prior is not None:
        raise UsageError(
            "--object: several objects exclude --camera, --watch and --prior; give one object, or leave these out"
        )
    elif request.approach:
        raise UsageError("--approach needs exactly one object; give one by --object")
    return objects


def _reports(report: str | None, out: Path | None) -> list[str]:
    """The reports to write into ``out``."""
    if report is None:
        return [kind.value for kind in Report if kind is not Report.none]
    options.check_name("report", report, Report)
    if report == Report.none:
        return []
    if out is None:
        raise UsageError("--report needs --out, the folder to write into; give it")
    return [report]


def _identified(
    request: Request,
    images: Sequence[ImageFile],
    sensors: Sequence[str | None],
    backgrounds: Sequence[str | None],
    objects: Sequence[str | None],
    placed: SensorPoses | None,
) -> tuple[Identification, dict[str, float]]:
    """The object, of ``objects``, and its posterior; and the time to read the images and to prepare the indexes [ms].

    ``sensors`` and ``backgrounds`` have one for each image.
    """
    from geomtact.cli.several import units_of
    from geomtact.identification import identify
    from geomtact.sensing.reading import read_observation

    began = time.perf_counter()
    # a bad image is reported before minutes go into an index, and a missing sensor by opening the index
    observations = [
        read_observation(image, gel, request.kind, background)
        for image, sensor, background in zip(images, sensors, backgrounds, strict=True)
        if (gel := request.mounted(sensor)) is not None
    ]
    timing_ms = {"read": 1e3 * (time.perf_counter() - began), "prepare": 0.0}
    frame = "sensor" if placed is None else "world"
    units = dict(zip(objects, units_of(objects, request.values["unit"]), strict=True))

    def opened(name: str | None) -> Localizer:
        began = time.perf_counter()
        own, announce = {"object": name, "unit": units[name]}, name == objects[0]
        on = {s: request.open({**own, "sensor": s}, frame, announce=announce) for s in dict.fromkeys(sensors)}
        timing_ms["prepare"] += 1e3 * (time.perf_counter() - began)
        first, *others = (on[sensor] for sensor in sensors)
        return replace(first, others=tuple(others)) if len(on) > 1 else first

    found = identify(
        map(opened, objects),
        observations,
        T_world_sensor=None if placed is None else placed.T_world_sensor,
        prior=request.prior,
        effort=request.effort,
        seed=request.seed,
        extrinsics_std=None if placed is None else placed.extrinsics_std,
    )
    return found, timing_ms


def _warn_of_metadata(image: Path, metadata: Mapping[str, Any], name: str | None, sensor: str | None) -> None:
    """Warn where an image's metadata name another object or sensor than it is localized with."""
    from geomtact.files import printable

    for word, key, used in (("of", "object", name), ("with", "sensor", sensor)):
        made = metadata.get(f"geomtact:{key}")
        if made and used and Path(made).stem != printable(Path(used).stem):
            to_stderr(f"warning: {image} was made {word} {made} by its metadata, but is localized with {used}")


def _check_images(images: list[Path], sensor_poses: Path | None) -> None:
    """Refuse no images, folders, and several images that nothing places.

    Raises
    ------
    UsageError, InputError
    """
    if not images:
        raise UsageError("expected an image, got none; give one, a folder with --watch, or --camera 0")
    for image in images:
        if image.is_dir():
            raise InputError(
                f"{image}: expected an image, got a folder; give the images in it, use --watch for the newest, or "
                "'geomtact track' for a sequence"
            )
    if sensor_poses is None and len(images) > 1:
        raise UsageError(f"{len(images)} images need --sensor-poses FILE.json; or localize them one at a time")
