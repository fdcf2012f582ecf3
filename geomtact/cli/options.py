"""The options that several commands share, and the names that they know."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from geomtact.errors import InputError, UsageError, nearest_name


class Kind(StrEnum):
    auto = "auto"
    mask = "mask"
    height = "height"
    reading = "reading"


class Effort(StrEnum):
    fast = "fast"
    balanced = "balanced"
    exact = "exact"


Unit = Annotated[str | None, typer.Option("--unit", help="Unit of a mesh file without one: mm, cm, m or inch.")]
ScorerName = Annotated[
    str | None, typer.Option("--scorer", help="How contacts are compared: a score by name, or weights (.safetensors).")
]
MaxPoses = Annotated[
    int | None,
    typer.Option(
        "--max-poses",
        min=1000,
        help="About how many poses; plane faces add up to a quarter, on plates three quarters. 1.2 million by default.",
        show_default=False,
    ),
]
Approaches = Annotated[
    list[str] | None,
    typer.Option(
        "--approach",
        metavar="X,Y,Z[:DEGREES]",
        help="Side that is touched, as the direction from the part towards the sensor in the part's frame: exactly that face, or "
        "within so many degrees of it. May be repeated.",
        show_default=False,
    ),
]
SensorName = Annotated[str | None, typer.Option("--sensor", help="Name (see 'geomtact sensors') or TOML file.")]
KindName = Annotated[str, typer.Option("--kind", metavar="|".join(Kind), help="What the images are.")]
Background = Annotated[Path | None, typer.Option("--background", help="Image of the untouched sensor, for readings.")]
EffortName = Annotated[
    str | None,
    typer.Option(
        "--effort",
        metavar="|".join(Effort),
        help="How much to compute; balanced by default.",
        show_default=False,
    ),
]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of all randomness.")]
CacheDir = Annotated[
    Path | None,
    typer.Option(
        "--cache-dir", help="Folder of the cached indexes; else $GEOMTACT_CACHE, else the user's cache folder."
    ),
]


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
