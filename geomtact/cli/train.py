"""``geomtact train``: the shared encoder from nothing, or fine-tuned for one part."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geomtact.cli.prepare import Unit
from geomtact.cli.shell import progress_bar, tell
from geomtact.errors import UsageError

_TUNING_RATE = 3e-4  # a step of fine-tuning must not undo what many parts taught


def train(
    out: Annotated[Path, typer.Option(help="Weights file to write; the card and curves go beside it.")] = Path(
        "encoder.safetensors"
    ),
    object_name: Annotated[
        str | None, typer.Option("--object", metavar="OBJECT", help="Fine-tune for this part or mesh file.")
    ] = None,
    unit: Unit = None,
    sensor: Annotated[str, typer.Option(help="Of the part: name or TOML file.")] = "gelslim",
    scenes: Annotated[int | None, typer.Option(min=50, help="Scenes; 600 by default, 80 of one part.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps; 4000 by default, 600 for one part.")] = None,
    start: Annotated[
        Path | None, typer.Option(help="Weights to start from; for one part those that geomtact brings along.")
    ] = None,
    architecture: Annotated[
        str, typer.Option(help="encoder, or resnet50: the thesis's network, for one part alone.")
    ] = "encoder",
    pairs: Annotated[int, typer.Option(min=32, help="Pairs of contacts that a resnet50 learns from.")] = 100_000,
    side: Annotated[int, typer.Option(min=32, help="Pixels along the side of a resnet50's images.")] = 224,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 0,
    work: Annotated[
        Path | None, typer.Option(help="Folder for scenes and state; by default one named after --out.")
    ] = None,
) -> None:
    """Train the encoder that compares contacts. A stopped run goes on where it was.

    Without --object it learns from procedural parts and serves every part. With --object, the shared encoder is
    fine-tuned on simulated touches of that part. Use the result as Localizer.prepare(..., scorer="FILE.safetensors").
    """
    if out.suffix != ".safetensors":
        raise UsageError(f"--out {out}: expected a name that ends in .safetensors")
    if architecture not in ("encoder", "resnet50"):
        raise UsageError(f"--architecture {architecture}: expected encoder or resnet50")
    work = work or out.with_name(f"{out.stem}.training")
    if architecture == "resnet50":
        if object_name is None:
            raise UsageError("--architecture resnet50: the thesis's network is trained for one part; give --object")
        _train_resnet(out, work, object_name, unit, sensor, pairs, side, seed)
        return
    from geomtact.scoring.encoder import WEIGHTS
    from geomtact.training import dataset
    from geomtact.training.card import read_weights, write_encoder
    from geomtact.training.train import Settings
    from geomtact.training.train import train as run

    settings = Settings(steps=steps or 4000, seed=seed)
    with progress_bar("training") as progress:
        if object_name is None:
            n = scenes or 600
            made = dataset.shared_scenes(work / "scenes", n, seed, progress)
            data = {"parts": "procedural", "sensors": dataset.SENSORS, "sizes": dataset.SIZES, "poses": dataset.POSES}
        else:
            from dataclasses import replace

            from geomtact.contact_space.resolution import MAX_POSES
            from geomtact.geometry.mesh import load_mesh
            from geomtact.sensing.sensor import Sensor

            gel = Sensor.load(sensor)
            mesh = load_mesh(object_name, unit, sensor=gel)
            n = scenes or 80
            made = dataset.part_scenes(work / "scenes", mesh, gel, MAX_POSES, n, seed, progress)
            data = {"part": mesh.name, "sha256": mesh.sha256, "sensor": gel.name}
            settings = replace(settings, steps=steps or 600, rate=_TUNING_RATE, validation=max(n // 8, 5))
            start = start or WEIGHTS
        if start is not None:
            data["start"] = start.name
        network, curve = run(made, settings, work, progress, start=read_weights(start) if start is not None else None)
    write_encoder(out, network, curve, settings, made, data)
    tell(f"{curve.validation[-1]:.2f} nats on scenes that it never saw")
    typer.echo(f"written: {out}, {out.with_suffix('.json').name} and {out.with_suffix('.png').name}")


def _train_resnet(
    out: Path, work: Path, object_name: str, unit: str | None, sensor: str, pairs: int, side: int, seed: int
) -> None:
    """The thesis's network for one part."""
    from geomtact.contact_space.space import ContactSpace
    from geomtact.geometry.mesh import load_mesh
    from geomtact.sensing.sensor import Sensor
    from geomtact.training.thesis import Settings, train_thesis

    gel = Sensor.load(sensor)
    mesh = load_mesh(object_name, unit, sensor=gel).with_symmetry()
    with progress_bar("training") as progress:
        train_thesis(ContactSpace(mesh, gel), Settings(pairs=pairs, side=side, seed=seed), work, out, progress)
    typer.echo(f"written: {out} and {out.with_suffix('.json').name}")
