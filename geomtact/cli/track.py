"""``geomtact track``: a part followed through a sequence of images, a line of JSON for each."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.library import CacheDir
from geomtact.cli.localize import Effort, Kind, _check_name
from geomtact.cli.prepare import MaxPoses, ScorerName, SensorName, Unit, open_localizer
from geomtact.cli.shell import NO_CONTACT, tell
from geomtact.errors import InputError, UsageError

if TYPE_CHECKING:
    from geomtact.inference.posterior import Posterior

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".npy")
_POLL = 0.05  # s between looks into a folder that is being filled
Frame = tuple[float | None, Any]  # time [s], where the source tells it, and path or array


def track(
    source: Annotated[
        str, typer.Argument(metavar="DIR|VIDEO|-", help="Folder of images, video, or - for paths from standard input.")
    ],
    object_name: Annotated[
        str | None, typer.Option("--object", help="Part (see 'geomtact objects') or mesh file.")
    ] = None,
    unit: Unit = None,
    sensor: SensorName = None,
    kind: Annotated[str, typer.Option(metavar="|".join(Kind), help="What the images are.")] = Kind.auto.value,
    background: Annotated[Path | None, typer.Option(help="Image of the untouched sensor, for readings.")] = None,
    prior: Annotated[Path | None, typer.Option(help="posterior.npz of what is known before the first frame.")] = None,
    effort: Annotated[
        str | None,
        typer.Option(metavar="|".join(Effort), help="How much to compute; balanced by default.", show_default=False),
    ] = None,
    scorer: ScorerName = None,
    motion_mm: Annotated[
        float, typer.Option(min=0.001, help="How far the part moves between frames at most, mean over its points.")
    ] = 8.0,
    most: Annotated[
        int | None, typer.Option(min=1, help="Cells kept between frames at most, for speed; all that count by default.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Wait for more images in the folder, until Ctrl-C.")] = False,
    skip_broken: Annotated[
        bool, typer.Option("--skip-broken", help="Go on after an image that cannot be read.")
    ] = False,
    tum: Annotated[
        Path | None, typer.Option(help="Write the first modes as a TUM trajectory: timestamp tx ty tz qx qy qz qw.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write one HTML file that plays the sequence.")] = None,
    fps: Annotated[float, typer.Option(min=1e-6, help="Images a second, for the timestamps of a folder.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 0,
    max_poses: MaxPoses = None,
    cache_dir: CacheDir = None,
) -> None:
    """Follow a part through a sequence of images: print one line of JSON a frame, as soon as it is known.

    What is not given is taken from the nearest geomtact.toml (this folder or above), then from the first image's metadata.
    Exit status: 0 done, 2 usage error, 3 bad input, 4 no contact in any image.
    """
    from geomtact.cli.project import resolve

    _check_name("kind", kind, Kind)
    if prior is not None and not prior.is_file():
        raise InputError(f"--prior {prior}: no such file; give a posterior.npz")
    if follow and not Path(source).is_dir():
        raise UsageError(f"--follow: expected a folder to watch, got {source}")
    given = {
        "object": object_name,
        "unit": unit,
        "sensor": sensor,
        "background": None if background is None else str(background),
        "effort": effort,
    }
    values, sources = resolve(given, _metadata(source))
    chosen = values["effort"] or Effort.balanced.value
    _check_name("effort", chosen, Effort, sources.get("effort"))
    frames = _frames(source, follow)
    localizer = open_localizer(values, sources, scorer, cache_dir, max_poses)

    from geomtact.inference.motion import UniformBall
    from geomtact.inference.sequence import track as posteriors

    options: dict[str, Any] = {"kind": kind, "background": values["background"], "prior": prior, "effort": chosen}
    options |= {"motion": UniformBall(1e-3 * motion_mm), "most": most, "on_error": "skip" if skip_broken else "raise"}
    times: deque[float | None] = deque()
    lines: list[str] = []
    shown: list[dict[str, Any]] = []
    touched = False
    try:
        for n, posterior in enumerate(posteriors(localizer, _images(frames, times), seed=seed, **options), 1):
            told = times.popleft()
            line = _line(n, posterior)
            touched |= posterior.contact
            typer.echo(_json(line))
            if line["T"] is not None:
                lines.append(_tum(n / fps if told is None else told, line))
            if report is not None:
                from geomtact.report.sequence_page import sequence_frame

                shown.append(sequence_frame(posterior, line, localizer.simulate))
    except KeyboardInterrupt:
        tell("stopped")
    if tum is not None:
        _write(tum, "".join(lines))
    if report is not None and shown:
        from geomtact.report.sequence_page import sequence_page

        _write(report, sequence_page(localizer.mesh.name, localizer.sensor.name, shown))
    if not touched:
        tell("no contact found in any image; give a --background, or say what they are with --kind")
        raise typer.Exit(NO_CONTACT)


def _write(path: Path, text: str) -> None:
    from geomtact.files import write_whole

    write_whole(path, lambda temporary: temporary.write_text(text, "utf-8"))


def _line(n: int, posterior: Posterior) -> dict[str, Any]:
    from geomtact.se3 import quat_xyzw

    first = next(iter(posterior.modes(1)), None)
    return {
        "frame": n,
        "contact": posterior.contact,
        "entropy_nats": posterior.entropy_nats if posterior.contact else None,
        "surprise_nats": posterior.settings["surprise_nats"],
        "probability": None if first is None else first.probability,
        "T": None if first is None else first.T,
        "quat_xyzw": None if first is None else quat_xyzw(first.T),
        "translation_mm": None if first is None else 1e3 * first.T[:3, 3],
        "warnings": posterior.warnings,
    }


def _json(line: dict[str, Any]) -> str:
    import json

    from geomtact.report.result import plain

    return json.dumps(plain(line), allow_nan=False)


def _tum(time: float, line: dict[str, Any]) -> str:
    """A line of a TUM trajectory: seconds, metres, x y z w."""
    numbers = [*(1e-3 * line["translation_mm"]), *line["quat_xyzw"]]
    return " ".join([f"{time:.6f}", *(f"{x:.9f}" for x in numbers)]) + "\n"


def _metadata(source: str) -> dict[str, Any]:
    """What the first image of a folder says of itself."""
    from geomtact.sensing.reading import read_metadata

    images = _listed(Path(source)) if Path(source).is_dir() else []
    try:
        return read_metadata(images[0]) if images else {}
    except InputError:
        return {}  # told with its number when its turn comes


def _frames(source: str, follow: bool) -> Iterator[Frame]:
    """The frames of a source, in order.

    Raises
    ------
    UsageError, InputError
        At once, where it is no source of frames.
    """
    path = Path(source)
    if source == "-":
        return _named()
    if path.is_dir():
        images = _listed(path)
        if not images and not follow:
            raise InputError(f"{path}: no image in this folder; expected {', '.join(_IMAGES)}")
        return _followed(path) if follow else ((None, str(image)) for image in images)
    if not path.is_file():
        raise InputError(f"{path}: no such folder or video; give a folder of images, a video, or - for paths")
    if path.suffix.lower() in _IMAGES:
        raise UsageError(f"{path}: is one image; give its folder, or use 'geomtact localize'")
    return _filmed(path)


def _images(frames: Iterator[Frame], times: deque[float | None]) -> Iterator[Any]:
    """The images alone; their times are put into ``times``."""
    for time, image in frames:
        times.append(time)
        yield image


def _listed(folder: Path) -> list[Path]:
    """The images in a folder by name, numbers in it by value: 2 before 10."""
    images = (path for path in folder.iterdir() if path.suffix.lower() in _IMAGES and not path.name.startswith("."))
    return sorted(
        images, key=lambda path: [(not s.isdigit(), int(s) if s.isdigit() else 0, s) for s in _parts(path.name)]
    )


def _parts(name: str) -> list[str]:
    return [s for s in re.split(r"(\d+)", name) if s]


def _followed(folder: Path) -> Iterator[Frame]:
    """The images of a folder and those that are written into it, for ever; each once it has stopped growing."""
    import time

    seen: set[Path] = set()
    sizes: dict[Path, int] = {}
    while True:
        for path in _listed(folder):
            if path in seen:
                continue
            size = path.stat().st_size
            if size == 0 or sizes.get(path) != size:
                sizes[path] = size
                break  # the images after it wait, so that their order is kept
            seen.add(path)
            yield None, str(path)
        time.sleep(_POLL)


def _named() -> Iterator[Frame]:
    """The images named by standard input, a line each."""
    import sys

    for line in sys.stdin:
        if line.strip():
            yield None, line.strip()


def _filmed(path: Path) -> Iterator[Frame]:
    """The frames of a video (H, W, 3) RGB."""
    import cv2

    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise InputError(f"{path}: cannot be read as a video; give one that OpenCV reads, or a folder of images")

    def frames() -> Iterator[Frame]:
        while True:
            ok, image = video.read()
            if not ok:
                break
            yield 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC), image[..., ::-1]
        video.release()

    return frames()
