"""``geomtact localize``: from one image, or one per sensor, to the distribution of the object's pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import (
    Approaches,
    CacheDir,
    Effort,
    EffortName,
    Kind,
    KindName,
    MaxPoses,
    Mirror,
    Mounting,
    Rotate,
    ScorerName,
    Seed,
    SensorName,
    Unit,
    approach_from,
    check_name,
)
from geomtact.cli.prepare import open_localizer
from geomtact.cli.project import given_of, resolve
from geomtact.cli.shell import NO_CONTACT, check_folder, posterior_file, print_table, tell
from geomtact.errors import InputError, UsageError

if TYPE_CHECKING:
    from geomtact.cli.sensor_poses import SensorPoses
    from geomtact.geometry.approach import Approach
    from geomtact.inference.identify import Identification
    from geomtact.inference.localizer import Localizer

MODES = 5


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
            help="Object (see 'geomtact objects') or mesh file. For object identification: names with commas, or a folder.",
        ),
    ] = None,
    unit: Unit = None,
    sensor: SensorName = None,
    kind: KindName = Kind.auto.value,
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
    approach: Approaches = None,
    effort: EffortName = None,
    scorer: ScorerName = None,
    seed: Seed = 0,
    rotate: Rotate = None,
    mirror: Mirror = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="Instead of images: number, device or URL of a camera. Prints a JSON line for its newest image, repeatedly."
        ),
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", help="The same for the newest image in a folder.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for result.json, posterior.npz, report.html and report.png.")
    ] = None,
    report: Annotated[
        str | None,
        typer.Option(metavar="|".join(Report), help="Report to write into --out, both by default.", show_default=False),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print only result.json to standard output.")] = False,
    max_poses: MaxPoses = None,
    cache_dir: CacheDir = None,
) -> None:
    """Localize an object from one image, or one image per sensor: print the most probable poses and write a report.

    Options that you leave out come from the nearest geomtact.toml (this folder or above), then from the image's metadata.

    --camera and --watch localize the newest image, again and again, until Ctrl-C. Images in between are skipped. Without
    --background, the first image without contact serves as background.

    Exit status: 0 done, 2 usage error, 3 bad input, 4 no contact in the image.
    """
    from geomtact.cli.parts import parts_of
    from geomtact.cli.sensor_poses import read_sensor_poses
    from geomtact.sensing.reading import read_metadata

    check_folder(out)
    if report is not None:
        check_name("report", report, Report)
        if out is None and report != Report.none:
            raise UsageError("--report needs --out, the folder to write into; give it")
    prior = prior and posterior_file(prior, "--prior")
    images = images or []
    live = camera is not None or watch
    if live:
        unsuited = {"--out": out, "--sensor-poses": sensor_poses, "--json": as_json or None}
        _check_live(images, camera, watch, [name for name, value in unsuited.items() if value is not None])
    else:
        _check_images(images, sensor_poses)
    placed = read_sensor_poses(sensor_poses, len(images)) if sensor_poses is not None else None
    metadata = [] if live else [read_metadata(image) for image in images]
    if background and len(background) not in (1, len(images)):
        raise UsageError(f"--background: expected one, or one for each of {len(images)} images, got {len(background)}")
    first = background[0] if background else None
    values, sources = resolve(given_of(object_name, unit, sensor, first, effort), metadata[0] if metadata else {})
    backgrounds = [str(each) for each in background] if background and len(background) > 1 else None
    values["effort"] = chosen = values["effort"] or Effort.balanced.value
    check_name("kind", kind, Kind)
    check_name("effort", chosen, Effort, sources.get("effort"))
    parts = parts_of(values["object"])
    if len(parts) > 1 and (live or prior is not None):
        raise UsageError(
            "--object: several objects exclude --camera, --watch and --prior; give one object, or leave these out"
        )
    sides = approach_from(approach)
    if len(parts) > 1 and sides:
        raise UsageError("--approach needs exactly one object; give one by --object")
    if len(parts) == 1:
        values["object"] = parts[0]

    mounting = Mounting(rotate, mirror)
    asked = _Asked(
        images, kind, values, sources, prior, sides, scorer, seed, max_poses, cache_dir, mounting, backgrounds
    )
    if live:
        _follow(asked, camera)
        return
    found, took = _identified(asked, parts, placed)
    named = placed.sensor if placed is not None else None
    of_each: Sequence[str | None] = named or [values["sensor"]] * len(images)
    for image, told, used in zip(images, metadata, of_each, strict=True):
        _doubt(image, told, parts[0] if len(parts) == 1 else None, used)
    if len(parts) > 1 and found.foreign:
        tell("warning: the contact is out-of-distribution for every candidate: it may be of another object")
    for warning in found.posterior.warnings:
        tell(f"warning: {warning}")
    _give(asked, found, took, out, _reports(report), as_json)
    if not found.posterior.contact:
        tell(_without_contact(asked, found.posterior.observation.kind))
        raise typer.Exit(NO_CONTACT)


def _doubt(image: Path, told: Mapping[str, Any], part: str | None, sensor: str | None) -> None:
    """Warn where an image's metadata name another object or sensor than it is localized with."""
    from geomtact.files import printable

    for word, made, used in (("of", told.get("geomtact:object"), part), ("with", told.get("geomtact:sensor"), sensor)):
        if made and used and Path(made).stem != printable(Path(used).stem):
            tell(f"warning: {image} was made {word} {made} by its metadata, but is localized {word} {used}")


@dataclass(frozen=True)
class _Asked:
    """What is asked for, the command line, project files and metadata taken together.

    Attributes
    ----------
    values : object, unit, sensor, background and effort
    sources : where those which the command line did not give come from
    backgrounds : one for each image, where more than one was given
    """

    images: list[Path]
    kind: str
    values: dict[str, Any]
    sources: dict[str, str]
    prior: Path | None
    approach: Approach | None
    scorer: str | None
    seed: int
    max_poses: int | None
    cache_dir: Path | None
    mounting: Mounting
    backgrounds: list[str] | None

    def opened(self, own: dict[str, Any], quiet: bool = False, frame: str = "sensor") -> Localizer:
        """The localizer of what is asked for, with ``own`` values in the place of those; ``quiet``: where values come from is not
        told."""
        sources = {} if quiet else self.sources
        values = {**self.values, **own}
        return open_localizer(
            values,
            sources,
            self.scorer,
            self.cache_dir,
            self.max_poses,
            self.prior,
            frame,
            self.approach,
            mounting=self.mounting,
        )


def _follow(asked: _Asked, camera: str | None) -> None:
    """Localize the newest image of a camera, or of a folder, again and again."""
    from geomtact.cli.frames import camera_frames, newest_in
    from geomtact.cli.live import localize_live

    # a missing camera is reported before minutes go into an index
    sensor = asked.values["sensor"] and asked.mounting.of(asked.values["sensor"])
    frames = newest_in(asked.images[0]) if camera is None else camera_frames(camera, sensor)
    options = {"kind": asked.kind, "prior": asked.prior, "effort": asked.values["effort"], "seed": asked.seed}
    if not localize_live(asked.opened({}), frames, asked.values["background"], options):
        raise typer.Exit(NO_CONTACT)


def _identified(asked: _Asked, parts: Sequence[str | None], placed: SensorPoses | None) -> tuple[Identification, float]:
    """Which of ``parts`` is touched and where, and how long indexes took to prepare or read [ms]."""
    import time
    from dataclasses import replace

    from geomtact.cli.parts import units_of
    from geomtact.inference.identify import identify
    from geomtact.sensing.reading import read_observation

    images, values = asked.images, asked.values
    gels = placed.sensor if placed is not None and placed.sensor is not None else [values["sensor"]] * len(images)
    backgrounds = asked.backgrounds or [values["background"]] * len(images)
    for image, gel, background in zip(images, gels, backgrounds, strict=True):
        if gel is not None:
            # a bad image is reported before minutes go into an index
            read_observation(image, asked.mounting.of(gel), asked.kind, background)
    frame = "sensor" if placed is None else "world"
    took, units = 0.0, dict(zip(parts, units_of(parts, values["unit"]), strict=True))

    def opened(part: str | None) -> Localizer:
        nonlocal took
        began = time.perf_counter()
        own = {"object": part, "unit": units[part]}
        on = {gel: asked.opened({**own, "sensor": gel}, part != parts[0], frame) for gel in dict.fromkeys(gels)}
        took += 1e3 * (time.perf_counter() - began)
        first, *others = (on[gel] for gel in gels)
        return replace(first, others=tuple(others)) if len(on) > 1 else first

    found = identify(
        map(opened, parts),
        [str(image) for image in images],
        kind=asked.kind,
        background=asked.backgrounds or values["background"],
        T_world_sensor=None if placed is None else placed.T_world_sensor,
        prior=asked.prior,
        effort=values["effort"],
        seed=asked.seed,
        rig=None if placed is None else placed.rig,
    )
    return found, took


def _give(
    asked: _Asked, found: Identification, took: float, out: Path | None, reports: list[str], as_json: bool
) -> None:
    """Print what was found, after indexes ``took`` so long [ms], and write it into ``out``."""
    import time
    from dataclasses import asdict

    images, posterior = asked.images, found.posterior
    began = time.perf_counter()
    modes = posterior.modes(MODES)
    timing = {"prepare": took, "modes": 1e3 * (time.perf_counter() - began)}
    settings = {
        "image": str(images[0]) if len(images) == 1 else [str(image) for image in images],
        "kind": asked.kind,
        "prior": asked.prior and str(asked.prior),
        "rotate": asked.mounting.rotate,
        "mirror": asked.mounting.mirror,
        **asked.values,
        "taken_from": asked.sources,
        "cache_dir": asked.cache_dir and str(asked.cache_dir),
    }
    candidates = [asdict(candidate) for candidate in found.candidates] if len(found.candidates) > 1 else None
    if out is not None:
        from geomtact.report.shown import shown_of
        from geomtact.report.write import write_all

        shown = shown_of(posterior, found.localizer)
        content = write_all(out, posterior, modes, shown, settings, timing, candidates, reports)
    elif as_json:
        from geomtact.report.result import result

        content = result(posterior, modes, settings, timing, candidates)
    if as_json:
        from geomtact.report.result import to_text

        typer.echo(to_text(content), nl=False)
    else:
        if candidates:
            _print_candidates(found)
        _print(posterior, modes, out, reports)


def _without_contact(asked: _Asked, kind: str) -> str:
    """The message without contact; ``kind`` of the image as it was read."""
    where = "the image" if len(asked.images) == 1 else f"any of the {len(asked.images)} images"
    what = {"reading": "a tactile image", "height": "a depth map"}.get(kind, "a mask")
    advice = f"it was read as {what}; give --background, or another --kind"
    if kind == "mask":
        advice = "contact is where a mask is not 0; check the file, or touch more firmly"
    elif asked.values["background"] is not None:
        advice = "it equals the --background; check that this shows the untouched sensor, or touch more firmly"
    return f"no contact found in {where}; {advice}"


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


def _check_live(images: list[Path], camera: str | None, watch: bool, unsuited: list[str]) -> None:
    """Refuse what does not go with --camera or --watch.

    Raises
    ------
    UsageError, InputError
    """
    if camera is not None and (images or watch):
        raise UsageError("--camera replaces images and --watch; give one of them")
    if watch and len(images) != 1:
        raise UsageError(f"--watch: expected one folder, got {len(images)}")
    if watch and not images[0].is_dir():
        raise InputError(f"--watch {images[0]}: expected the folder that receives images; give it")
    if unsuited:
        raise UsageError(
            f"{unsuited[0]} excludes --camera and --watch, which print a JSON line per image; leave it out"
        )


def _print_candidates(found: Identification) -> None:
    rows = [
        [c.name, f"{100 * c.probability:.1f} %", f"{c.log_evidence:.1f}", "yes" if c.unlike else ""]
        for c in found.candidates
    ]
    print_table(("object", "probability", "log evidence", "outlier"), rows, ("probability", "log evidence"))


def _reports(asked: str | None) -> list[str]:
    """The reports that are written."""
    if asked is None:
        return [kind.value for kind in Report if kind is not Report.none]
    return [] if asked == Report.none else [asked]


def _named(reports: list[str]) -> str:
    """The reports' files, as a line lists them before others."""
    return f"report.{' and .'.join(reports)}, " if reports else ""


def _print(posterior, modes, out: Path | None, reports: list[str]) -> None:
    from geomtact.report.summary import HEADINGS, caution, facts, summaries_of, table

    typer.echo(f"{posterior.mesh.name} on {posterior.sensor.name}, {posterior.frame} frame")
    if modes:
        right = ["mode", "probability", "±"]
        summaries = summaries_of(posterior, modes)
        print_table(HEADINGS, table(summaries), right)
        for line in (*facts(posterior), *caution(summaries)):
            typer.echo(line)
    typer.echo(f"written: {out}/{_named(reports)}result.json, posterior.npz" if out else "for a report, give --out DIR")
