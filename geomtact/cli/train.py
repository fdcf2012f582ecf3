"""``geomtact train``: the shared encoder fine-tuned for an object, or the thesis's network for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import Seed, Unit
from geomtact.cli.several import Jobs, Ray, do_all, everywhere, objects_of, objects_with_units, quietly
from geomtact.cli.shell import progress_bar, to_stderr
from geomtact.errors import UsageError

if TYPE_CHECKING:
    from geomtact.geometry.mesh import Mesh
    from geomtact.sensing.sensor import Sensor

# options that an architecture does not have
_UNSUITED = {"encoder": ("pairs", "side"), "resnet50": ("scenes", "steps", "start")}
_TUNING_RATE = 3e-4  # of the 2e-3 of a training from nothing: fine-tuning keeps most of what the start has learned


def train(
    object_name: Annotated[
        str,
        typer.Option(
            "--object",
            metavar="OBJECT",
            help="Object or mesh file to train for; for several: names with commas, or a folder.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(help="Weights file to write, with its card beside it; a folder if there are several objects."),
    ] = Path("encoder.safetensors"),
    unit: Unit = None,
    sensor: Annotated[str, typer.Option(help="Sensor (see 'geomtact sensors') or TOML file.")] = "gelslim",
    scenes: Annotated[
        int | None, typer.Option(min=50, help="Simulated scenes to train the encoder on; 80 by default.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps of the encoder; 600 by default.")] = None,
    start: Annotated[
        Path | None, typer.Option(help="Weights that the encoder starts from; the bundled ones by default.")
    ] = None,
    architecture: Annotated[
        str, typer.Option(help="encoder: fine-tune the shared encoder; resnet50: train the thesis's network.")
    ] = "encoder",
    pairs: Annotated[
        int | None, typer.Option(min=32, help="Pairs of contacts to train resnet50 on; 100,000 by default.")
    ] = None,
    side: Annotated[
        int | None, typer.Option(min=32, help="Side of resnet50's input images in pixels; 224 by default.")
    ] = None,
    rate: Annotated[float | None, typer.Option(min=1e-9, help="Learning rate, if the default diverges.")] = None,
    seed: Seed = 0,
    work: Annotated[
        Path | None, typer.Option(help="Folder for scenes and state; by default one named after --out.")
    ] = None,
    jobs: Jobs = None,
    ray: Ray = None,
) -> None:
    """Train a score for an object: fine-tune the shared encoder, or train the thesis's network.

    The network learns from simulated touches of the object. Of several objects, each gets its own weights; they are
    trained in parallel, one on each core. The same command resumes a stopped run. Use the result by --scorer
    FILE.safetensors, or in Python by Localizer.prepare(..., scorer="FILE.safetensors").
    """
    options = dict(locals())
    parts = objects_of(object_name)
    if len(parts) > 1:
        _train_each([str(part) for part in parts], options)
        return
    if jobs is not None or ray is not None:
        raise UsageError(
            "--jobs and --ray train for several objects; give their names by --object, with commas between them"
        )
    if out.suffix != ".safetensors":
        raise UsageError(f"--out {out}: expected a name that ends in .safetensors")
    if architecture not in _UNSUITED:
        raise UsageError(f"--architecture {architecture}: expected {' or '.join(_UNSUITED)}")
    for name in _UNSUITED[architecture]:
        if options[name] is not None:
            raise UsageError(f"--{name} does not go with --architecture {architecture}; leave it out")
    from geomtact.geometry.mesh_file import load_mesh
    from geomtact.scoring.encoder import THESIS
    from geomtact.sensing.sensor import Sensor

    work = work or out.with_name(f"{out.stem}.training")
    gel = Sensor.load(sensor)
    mesh = load_mesh(object_name, unit, sensor=gel)
    if architecture == THESIS:
        _train_thesis(out, work, mesh, gel, pairs or 100_000, side or 224, rate, seed)
        written = [out, out.with_suffix(".json").name]
    else:
        _fine_tune(out, work, mesh, gel, scenes or 80, steps or 600, start, rate or _TUNING_RATE, seed)
        written = [out, out.with_suffix(".json").name, out.with_suffix(".png").name]
    typer.echo(f"written: {', '.join(map(str, written[:-1]))} and {written[-1]}")


def _fine_tune(
    out: Path, work: Path, mesh: Mesh, sensor: Sensor, n: int, steps: int, start: Path | None, rate: float, seed: int
) -> None:
    """The shared encoder, or the weights ``start``, fine-tuned for one object."""
    from geomtact.contact_space.resolution import MAX_POSES
    from geomtact.scoring.encoder import ARCHITECTURE, WEIGHTS
    from geomtact.training.card import write_encoder
    from geomtact.training.dataset import object_scenes
    from geomtact.training.state import claim, read_weights, sha256_of, size_of, whose
    from geomtact.training.train import Settings
    from geomtact.training.train import train as run

    start = start or WEIGHTS
    recipe = {"part": mesh.sha256, "sensor": sensor.sha256, "start": sha256_of(start)}
    weights = read_weights(start)
    settings = Settings(steps=steps, **size_of(weights), seed=seed, rate=rate, validation=max(n // 8, 5))
    size = {"architecture": ARCHITECTURE, "width": settings.width, "dimension": settings.dimension, "seed": seed}
    claim(work, size | recipe)
    with progress_bar("training") as progress:
        made = object_scenes(work / "scenes", mesh, sensor, MAX_POSES, n, seed, progress)
        network, curve = run(made, settings, work, progress, start=weights)
    write_encoder(out, network, curve, settings, made, whose(mesh, sensor) | {"start": start.name})
    to_stderr(f"{curve.validation[-1]:.2f} nats on scenes that it never saw")


def _train_thesis(
    out: Path, work: Path, mesh: Mesh, sensor: Sensor, pairs: int, side: int, rate: float | None, seed: int
) -> None:
    """The thesis's network for one object."""
    from geomtact.contact_space.space import ContactSpace
    from geomtact.scoring.encoder import THESIS
    from geomtact.training.state import claim
    from geomtact.training.thesis import Settings, train_thesis

    settings = Settings(pairs=pairs, side=side, seed=seed)
    if rate is not None:
        settings = replace(settings, rate=rate)
    claim(work, {"architecture": THESIS, "seed": seed, "part": mesh.sha256, "sensor": sensor.sha256})
    with progress_bar("training") as progress:
        train_thesis(ContactSpace(mesh.with_symmetry(), sensor), settings, work, out, progress)


def _train_each(parts: list[str], options: dict[str, Any]) -> None:
    """For each of several objects, its own weights in the folder ``out``."""
    from geomtact.cli.shell import check_folder

    jobs, ray = options.pop("jobs"), options.pop("ray")
    folder: Path = options["out"]
    if folder.suffix:
        raise UsageError(f"--out {folder}: expected a folder for the weights of {len(parts)} objects")
    if options["work"] is not None:
        raise UsageError("--work: of several objects, each has its own folder beside its weights; leave it out")
    check_folder(folder)
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    start = options["start"] and options["start"].absolute()
    same = options | {"sensor": everywhere(options["sensor"]), "start": start}
    tasks = []
    for name, unit in objects_with_units(parts, options["unit"]):
        own = {"object_name": name, "unit": unit, "out": folder / f"{Path(name).stem}.safetensors"}
        tasks.append((train, same | own))
    do_all(quietly, tasks, parts, "trained", jobs, ray)
