"""The options that several commands share, and the names that they know."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomtact.errors import InputError, UsageError, nearest_name

if TYPE_CHECKING:
    from geomtact.sensing.sensor import Sensor


class Kind(StrEnum):
    auto = "auto"
    mask = "mask"
    height = "height"
    reading = "reading"


class Effort(StrEnum):
    fast = "fast"
    balanced = "balanced"
    exact = "exact"


Unit = Annotated[str | None, typer.Option("--unit", help="Unit of a mesh file that states none: mm, cm, m or inch.")]
ScorerName = Annotated[
    str | None, typer.Option("--scorer", help="Score that compares contacts: its name, or its weights (.safetensors).")
]
MaxPoses = Annotated[
    int | None,
    typer.Option(
        "--max-poses",
        min=1000,
        help="Number of poses in the contact index, 300,000 by default. Fewer is faster but coarser. "
        "Flat faces raise the count by up to 75 %.",
        show_default=False,
    ),
]
Approaches = Annotated[
    list[str] | None,
    typer.Option(
        "--approach",
        metavar="X,Y,Z[:DEGREES]",
        help="Known contact face, such as 0,0,1: direction from the object to the sensor, in the object's frame. DEGREES allows "
        "all directions within that angle. Repeat it for several faces; each of several sensors must touch one of them.",
        show_default=False,
    ),
]
SensorName = Annotated[str | None, typer.Option("--sensor", help="Sensor (see 'geomtact sensors') or TOML file.")]
KindName = Annotated[
    str,
    typer.Option(
        "--kind",
        metavar="|".join(Kind),
        help="What the images are: contact masks, depth maps (height) or tactile images (reading).",
    ),
]
Background = Annotated[Path | None, typer.Option("--background", help="Tactile image of the untouched sensor.")]
EffortName = Annotated[
    str | None,
    typer.Option(
        "--effort",
        metavar="|".join(Effort),
        help="Computing effort, balanced by default.",
        show_default=False,
    ),
]
Rotate = Annotated[
    int | None,
    typer.Option(
        "--rotate",
        metavar="0|90|180|270",
        help="Turn every image counter-clockwise by this angle. Overrides the sensor's file.",
        show_default=False,
    ),
]
Mirror = Annotated[
    bool | None,
    typer.Option(
        "--mirror/--no-mirror",
        help="Mirror every image left to right before it is turned. Overrides the sensor's file.",
        show_default=False,
    ),
]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of all random numbers.")]
CacheDir = Annotated[
    Path | None,
    typer.Option(
        "--cache-dir",
        help="Folder of cached contact indexes. Default: $GEOMTACT_CACHE, else the user's cache folder.",
    ),
]

MOTION_MM = 8.0  # the thesis's
Source = Annotated[
    str,
    typer.Argument(
        metavar="DIR|VIDEO|CAMERA|-",
        help="Folder of images, video, number of a camera, or - for paths on standard input.",
    ),
]
Objects = Annotated[
    list[str] | None, typer.Argument(metavar="OBJECT...", help="Objects (see 'geomtact objects') or mesh files.")
]
ObjectName = Annotated[str | None, typer.Option("--object", help="Object (see 'geomtact objects') or mesh file.")]
MotionMm = Annotated[
    float,
    typer.Option(
        min=0.001, max=1000, help="Largest motion between two images: mean displacement of the object's points."
    ),
]
Follow = Annotated[bool, typer.Option("--follow", help="Wait for more images in the folder, until Ctrl-C.")]
SkipBroken = Annotated[bool, typer.Option("--skip-broken", help="Skip images that cannot be read.")]


def approach_from(sides: list[str] | None) -> list[tuple[list[float], float]] | None:
    """``approach`` of ``Localizer.prepare``, from what ``--approach`` was given.

    Raises
    ------
    UsageError
    """
    if not sides:
        return None
    out = []
    for side in sides:
        direction, colon, angle = side.partition(":")
        try:
            x, y, z = (float(x) for x in direction.split(","))
            degrees = float(angle) if colon else 0.0
        except ValueError:
            raise UsageError(
                f"--approach: expected three numbers X,Y,Z or X,Y,Z:DEGREES, such as 0,0,1 or 0,0,1:5, got {side!r}"
            ) from None
        if not 0 <= degrees <= 180:
            raise UsageError(f"--approach: expected an angle of 0 to 180 degrees, got {side!r}")
        if not x**2 + y**2 + z**2:
            raise UsageError(f"--approach: expected a direction, got {side!r}, which has no length")
        out.append(([x, y, z], math.radians(degrees)))
    return out


@dataclass(frozen=True)
class Mounting:
    """How the camera is mounted by the command line; None where it leaves that to the sensor's file.

    Raises
    ------
    UsageError
        The angle is no quarter turn.
    """

    rotate: int | None = None
    mirror: bool | None = None

    def __post_init__(self) -> None:
        from geomtact.sensing.sensor import ROTATIONS

        if self.rotate is not None and self.rotate not in ROTATIONS:
            raise UsageError(f"--rotate: expected 0, 90, 180 or 270 degrees, counter-clockwise, got {self.rotate}")

    @property
    def is_given(self) -> bool:
        """Whether the command line gives any of it."""
        return self.rotate is not None or self.mirror is not None

    def of(self, sensor: str | Path | Sensor, masks: bool = True) -> Sensor:
        """The sensor, mounted so; with ``masks`` every image is turned, be it a mask or a depth map."""
        from geomtact.sensing.sensor import Sensor

        found = Sensor.load(sensor)
        if not self.is_given:
            return found
        rotation = found.camera_rotation_deg if self.rotate is None else self.rotate
        mirrored = found.camera_mirrored if self.mirror is None else self.mirror
        turned = replace(found, camera_rotation_deg=rotation, camera_mirrored=mirrored)
        return replace(turned, camera_masks=True) if masks else turned


def check_name(option: str, name: str, known: type[StrEnum], file: str | None = None) -> None:
    """Refuse an unknown name, which the command line gave or a ``geomtact.toml``.

    Raises
    ------
    UsageError, InputError
    """
    names = [k.value for k in known]
    if name not in names:
        what = f"no {option} named {name!r}{nearest_name(name, names)}"
        raise InputError(f"{file}: {what}") if file else UsageError(f"--{option}: {what}")
