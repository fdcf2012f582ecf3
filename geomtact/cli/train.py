"""``geomtact train``: the shared encoder from nothing, or fine-tuned for one part; and what finds contacts in readings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from geomtact.cli.options import Seed, Unit
from geomtact.cli.parallel import Jobs, Ray, do_all, everywhere, parts_of_tasks, quietly
from geomtact.cli.parts import parts_of
from geomtact.cli.shell import progress_bar, tell
from geomtact.errors import InputError, UsageError

MASK = "mask"  # a name for --architecture, beside those of encoders
# options that say nothing to an architecture
_OF_RESNET, _OF_ENCODER = ("pairs", "side"), ("width", "dimension")
_UNSUITED = {
    "encoder": _OF_RESNET,
    MASK: ("object_name", "unit", *_OF_RESNET, *_OF_ENCODER),
    "resnet50": ("scenes", "steps", "start", *_OF_ENCODER),
}
_TUNING_RATE = 3e-4  # a step of fine-tuning must not undo what many parts taught


def train(
    out: Annotated[
        Path, typer.Option(help="Weights file to write, a folder for several; the card and curves go beside it.")
    ] = Path("encoder.safetensors"),
    object_name: Annotated[
        str | None,
        typer.Option(
            "--object",
            metavar="OBJECT",
            help="Fine-tune for this part or mesh file; for each of several by a folder, or names with commas.",
        ),
    ] = None,
    unit: Unit = None,
    sensor: Annotated[str, typer.Option(help="Of the part: name or TOML file.")] = "gelslim",
    scenes: Annotated[int | None, typer.Option(min=50, help="Scenes; 600 by default, 80 of one part.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps; 4000 by default, 600 for one part.")] = None,
    start: Annotated[
        Path | None, typer.Option(help="Weights to start from; for one part those that geomtact brings along.")
    ] = None,
    architecture: Annotated[
        str,
        typer.Option(
            help="encoder; mask: what finds the contact in a reading; or resnet50: the thesis's network, for one part."
        ),
    ] = "encoder",
    pairs: Annotated[
        int | None, typer.Option(min=32, help="Pairs of contacts that a resnet50 learns from; 100,000 by default.")
    ] = None,
    side: Annotated[
        int | None, typer.Option(min=32, help="Pixels along the side of a resnet50's images; 224 by default.")
    ] = None,
    width: Annotated[int | None, typer.Option(min=8, help="Neurons a layer of an encoder; 512 by default.")] = None,
    dimension: Annotated[
        int | None, typer.Option(min=2, help="Numbers that an encoder makes of a contact; 16 by default.")
    ] = None,
    rate: Annotated[float | None, typer.Option(min=1e-9, help="Learning rate, where the usual one diverges.")] = None,
    seed: Seed = 0,
    work: Annotated[
        Path | None, typer.Option(help="Folder for scenes and state; by default one named after --out.")
    ] = None,
    jobs: Jobs = None,
    ray: Ray = None,
) -> None:
    """Train the encoder that compares contacts. A stopped run goes on where it was.

    Without --object it learns from procedural parts and serves every part. With --object, the shared encoder is fine-tuned on
    simulated touches of that part, or of each of several, one for each core at a time. Use the result as
    Localizer.prepare(..., scorer="FILE.safetensors").
    """
    options = dict(locals())
    parts = parts_of(object_name)
    if len(parts) > 1:
        _train_each([str(part) for part in parts], options)
        return
    if jobs is not None or ray is not None:
        raise UsageError("--jobs and --ray train for several parts: give them with --object, with commas between them")
    if out.suffix != ".safetensors":
        raise UsageError(f"--out {out}: expected a name that ends in .safetensors")
    from geomtact.scoring.encoder import ARCHITECTURE, THESIS, WEIGHTS

    if architecture not in (ARCHITECTURE, MASK, THESIS):
        raise UsageError(f"--architecture {architecture}: expected {ARCHITECTURE}, {MASK} or {THESIS}")
    for name in _UNSUITED[architecture]:
        if options[name] is not None:
            option = "--object" if name == "object_name" else f"--{name}"
            raise UsageError(f"{option} does not go with --architecture {architecture}; leave it out")
    work = work or out.with_name(f"{out.stem}.training")
    if architecture == MASK:
        _train_mask(out, work, scenes or 600, steps or 6000, rate, seed, start)
        return
    if architecture == THESIS:
        if object_name is None:
            raise UsageError(f"--architecture {THESIS}: the thesis's network is trained for one part; give --object")
        _train_thesis(out, work, object_name, unit, sensor, pairs or 100_000, side or 224, rate, seed)
        return
    from geomtact.training import dataset
    from geomtact.training.card import write_encoder
    from geomtact.training.state import claim, read_weights, whose
    from geomtact.training.train import Settings
    from geomtact.training.train import train as run

    settings = Settings(steps=steps or 4000, width=width or 512, dimension=dimension or 16, seed=seed)
    recipe = {"architecture": ARCHITECTURE, "width": settings.width, "dimension": settings.dimension, "seed": seed}
    with progress_bar("training") as progress:
        if object_name is None:
            n = scenes or 600
            claim(work, recipe | {"start": _sha256(start)})
            made = dataset.shared_scenes(work / "scenes", n, seed, progress)
            data: dict[str, Any] = {
                "parts": "procedural",
                "sensors": dataset.SENSORS,
                "sizes": dataset.SIZES,
                "poses": dataset.POSES,
            }
        else:
            from geomtact.contact_space.resolution import MAX_POSES
            from geomtact.geometry.mesh_file import load_mesh
            from geomtact.sensing.sensor import Sensor

            gel = Sensor.load(sensor)
            mesh = load_mesh(object_name, unit, sensor=gel)
            n = scenes or 80
            start = start or WEIGHTS
            claim(work, recipe | {"part": mesh.sha256, "sensor": gel.sha256, "start": _sha256(start)})
            made = dataset.part_scenes(work / "scenes", mesh, gel, MAX_POSES, n, seed, progress)
            data = whose(mesh, gel)
            settings = replace(settings, steps=steps or 600, rate=_TUNING_RATE, validation=max(n // 8, 5))
        if rate is not None:
            settings = replace(settings, rate=rate)
        if start is not None:
            data["start"] = start.name
        network, curve = run(made, settings, work, progress, start=read_weights(start) if start is not None else None)
    write_encoder(out, network, curve, settings, made, data)
    tell(f"{curve.validation[-1]:.2f} nats on scenes that it never saw")
    typer.echo(f"written: {out}, {out.with_suffix('.json').name} and {out.with_suffix('.png').name}")


def _train_each(parts: list[str], options: dict[str, Any]) -> None:
    """For each of several parts, weights of its own in the folder ``out``."""
    from geomtact.cli.shell import check_folder

    jobs, ray = options.pop("jobs"), options.pop("ray")
    folder: Path = options["out"]
    if folder.suffix:
        raise UsageError(f"--out {folder}: expected a folder for the weights of {len(parts)} parts")
    if options["work"] is not None:
        raise UsageError("--work: with several parts each has its own, beside its weights; leave it out")
    check_folder(folder)
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    start = options["start"] and options["start"].absolute()
    same = options | {"sensor": everywhere(options["sensor"]), "start": start}
    tasks = []
    for name, unit in parts_of_tasks(parts, options["unit"]):
        own = {"object_name": name, "unit": unit, "out": folder / f"{Path(name).stem}.safetensors"}
        tasks.append((train, same | own))
    do_all(quietly, tasks, parts, "trained", jobs, ray)


def _sha256(path: Path | None) -> str | None:
    """Of the weights to start from."""
    import hashlib

    if path is None:
        return None
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        raise InputError(f"--start {path}: no such file; give a file that 'geomtact train' wrote") from None


def _train_mask(
    out: Path, work: Path, parts: int, steps: int, rate: float | None, seed: int, start: Path | None
) -> None:
    """The network that finds the contact in a reading."""
    from geomtact.training.presses import make_presses
    from geomtact.training.state import claim, read_weights
    from geomtact.training.train_mask import Settings, train_mask, write_mask_network

    settings = Settings(steps=steps, seed=seed)
    if rate is not None:
        settings = replace(settings, rate=rate)
    began, weights = _sha256(start), None if start is None else read_weights(start)
    claim(work, {"architecture": MASK, "seed": seed, "start": began})
    with progress_bar("training") as progress:
        made = make_presses(work / "presses", parts, seed, progress)
        network, curve = train_mask(made, settings, work, progress, start=weights)
    write_mask_network(out, network, curve, settings, sum(len(p.seen) for p in made), began)
    tell(f"overlaps the contact by {curve['validation'][-1]:.2f} on parts that it never saw")
    typer.echo(f"written: {out} and {out.with_suffix('.json').name}")


def _train_thesis(
    out: Path,
    work: Path,
    object_name: str,
    unit: str | None,
    sensor: str,
    pairs: int,
    side: int,
    rate: float | None,
    seed: int,
) -> None:
    """The thesis's network for one part."""
    from geomtact.contact_space.space import ContactSpace
    from geomtact.geometry.mesh_file import load_mesh
    from geomtact.scoring.encoder import THESIS
    from geomtact.sensing.sensor import Sensor
    from geomtact.training.state import claim
    from geomtact.training.thesis import Settings, train_thesis

    gel = Sensor.load(sensor)
    mesh = load_mesh(object_name, unit, sensor=gel).with_symmetry()
    settings = Settings(pairs=pairs, side=side, seed=seed)
    if rate is not None:
        settings = replace(settings, rate=rate)
    claim(work, {"architecture": THESIS, "seed": seed, "part": mesh.sha256, "sensor": gel.sha256})
    with progress_bar("training") as progress:
        train_thesis(ContactSpace(mesh, gel), settings, work, out, progress)
    typer.echo(f"written: {out} and {out.with_suffix('.json').name}")
