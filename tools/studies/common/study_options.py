"""The options that the studies share, and what they stand for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomtact.cli.options import Effort
from geomtact.cli.shell import progress_bar
from geomtact.cli.simulate import NoiseName

if TYPE_CHECKING:
    from geomtact.geometry.approach import Approach
    from geomtact.geometry.mesh import Mesh
    from geomtact.localizer import Localizer
    from geomtact.sensing.noise import Noise
    from geomtact.sensing.sensor import Sensor


class FeltName(StrEnum):
    elastic = "elastic"
    rigid = "rigid"
    both = "both"


class ClassName(StrEnum):
    flat = "flat"
    edge = "edge"
    corner = "corner"
    cylinder = "cylinder"
    texture = "texture"


Parts = Annotated[list[str], typer.Argument(metavar="OBJECT...", help="Parts (see 'geomtact objects') or mesh files.")]
ThesisParts = Annotated[
    list[str] | None,
    typer.Argument(metavar="OBJECT...", help="Parts or mesh files; the thesis's four by default.", show_default=False),
]
SensorName = Annotated[str, typer.Option("--sensor", help="Name (see 'geomtact sensors') or TOML file.")]
Touches = Annotated[int, typer.Option("--touches", min=1, help="How many touches of each part.")]
NoiseLevel = Annotated[NoiseName, typer.Option("--noise", help="How strongly the masks are spoilt.")]
Felt = Annotated[FeltName, typer.Option("--felt", help="What the gel is.")]
Only = Annotated[
    ClassName | None, typer.Option("--only", help="Touches of one kind of contact; all by default.", show_default=False)
]
EffortLevel = Annotated[Effort, typer.Option("--effort", help="How much to compute.")]
Out = Annotated[
    Path | None, typer.Option("--out", help="JSON file for all figures; a study that it holds in part is resumed.")
]
Plot = Annotated[Path | None, typer.Option("--plot", help="PNG that shows the figures.")]


def noise_named(name: str) -> Noise:
    """What a :class:`NoiseName` stands for."""
    from geomtact.sensing import noise

    return {"none": noise.CLEAN, "moderate": noise.MODERATE, "heavy": noise.HEAVY}[name]


def meshes(parts: Sequence[str | Path] | None, unit: str | None, sensor: Sensor) -> list[Mesh]:
    """The meshes of the parts, the thesis's four by default: a wrong name is told before any work is done."""
    from geomtact.cli.several import units_of
    from geomtact.geometry.mesh_file import load_mesh
    from tools.studies.common.study import THESIS_PARTS

    parts = parts or THESIS_PARTS
    return [load_mesh(part, own, sensor=sensor) for part, own in zip(parts, units_of(parts, unit), strict=True)]


def localizers(
    parts: Sequence[str | Path] | None,
    unit: str | None,
    sensor: str,
    cache_dir: Path | None,
    max_poses: int | None = None,
    approach: Callable[[Mesh], Approach] | None = None,
) -> Iterator[Localizer]:
    """A localizer for each part, the thesis's four by default, prepared when its turn comes."""
    from geomtact.contact_space.resolution import MAX_POSES
    from geomtact.localizer import Localizer
    from geomtact.sensing.sensor import Sensor

    gel = Sensor.load(sensor)
    for mesh in meshes(parts, unit, gel):
        with progress_bar(f"preparing {mesh.name}") as progress:
            localizer = Localizer.prepare(
                mesh,
                sensor=gel,
                approach=approach and approach(mesh),
                max_poses=max_poses or MAX_POSES,
                cache_dir=cache_dir,
                progress=progress,
            )
        yield localizer
