"""``python -m tools.studies choices``: information gain, error and time of each variant, on the same touches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import Seed, Unit
from geomtact.cli.shell import print_table, progress_bar, to_stderr
from tools.studies.common import study_file, study_options

if TYPE_CHECKING:
    from geomtact.geometry.mesh import Mesh
    from geomtact.localizer import Localizer
    from geomtact.sensing.sensor import Sensor

SCHEMA = "geomtact/choices/2"


def judge_choices(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    touches: Annotated[
        int, typer.Option("--touches", min=2, help="How many scenes of each kind, for each object.")
    ] = 100,
    seed: Seed = 3,
    weights: Annotated[
        list[Path] | None,
        typer.Option(
            "--weights",
            help="Weights of 'geomtact train': an encoder of another size, or the thesis's network; each is a further variant.",
            show_default=False,
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--variant", help="Judge this variant beside the default, not all; may be given again.", show_default=False
        ),
    ] = None,
    out: study_options.Out = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="PNG of information gain and error against time.")] = None,
    plot_ablations: Annotated[
        Path | None, typer.Option("--plot-ablations", help="PNG of the gain of each choice.")
    ] = None,
) -> None:
    """Judge choices: efforts, grids, registration, images and contact faces, each against the default.

    All variants meet each touch in turn. Everything is prepared anew in a folder that is removed afterwards, so that the time of
    preparing is measured. Prints tables, and writes all estimates to --out.
    """
    from geomtact.contact_space.store import FORMAT
    from geomtact.evaluation import identity
    from geomtact.json_values import plain
    from geomtact.sensing.sensor import Sensor
    from tools.studies.choices import study as choices

    content, gel = study_file.load(out, SCHEMA), Sensor.load(sensor)
    variants = choices.variants_of(weights or [], only or [])
    for mesh in study_options.meshes(parts, unit, gel):
        settings = plain(
            identity(mesh, gel)
            | {
                "index_format": FORMAT,
                "touches": touches,
                "seed": seed,
                "variants": {
                    name: asdict(variant) | {"scorer": Path(variant.scorer).name} for name, variant in variants.items()
                },
            }
        )
        found = content["parts"].get(mesh.name)
        known = dict(found) if study_file.begun(found, settings) else {"variants": {}, "scenes": {}}
        part = known | {"settings": settings}
        done = {kind: list(part["scenes"].get(kind, {}).get("answers", [])) for kind in choices.scenes_of(variants)}
        if any(len(some) < touches for some in done.values()):
            _judge(mesh, gel, variants, part, done, touches, seed, lambda part=part: _keep(out, content, part))
        _summarise(part)
        _keep(out, content, part)
        _print(mesh.name, part)
        to_stderr(f"{mesh.name}: done")
    study_file.plot(content, plot)
    study_file.plot(content, plot_ablations, "ablations")


def _keep(out: Path | None, content: dict[str, Any], part: Mapping[str, Any]) -> None:
    study_file.keep(out, content, part["settings"]["object"], **part)


def _judge(
    mesh: Mesh,
    sensor: Sensor,
    variants: Mapping[str, Any],
    part: dict[str, Any],
    done: dict[str, list],
    n: int,
    seed: int,
    save: Any,
) -> None:
    """Prepare every variant and localize the remaining scenes with each."""
    import tempfile

    from tools.studies.choices import study as choices
    from tools.studies.scores.study import bytes_per_pose

    localizers: dict[str, Localizer] = {}
    spent: dict[tuple[Any, ...], float | None] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, variant in variants.items():
            with progress_bar(f"preparing {mesh.name}, {name}") as progress:
                localizers[name], seconds = choices.prepare(mesh, sensor, variant, Path(folder), progress)
            spent.setdefault(variant.prepared, seconds)
            part["variants"][name] = {
                "choice": variant.choice,
                "poses": len(localizers[name].index),
                "bytes_per_pose": bytes_per_pose(localizers[name].scorer.scorer, localizers[name].index),
                "prepare_s": spent[variant.prepared],
            }
        for kind in done:
            scenes = choices.make(kind, localizers[choices.DEFAULT], n, seed)
            todo = choices.localized(localizers, variants, scenes[len(done[kind]) :], kind, seed)
            rows = ({name: asdict(answer) for name, answer in each.items()} for each in todo)

            def keep(answers: list, kind: str = kind) -> None:
                part["scenes"][kind] = {"answers": answers}
                save()

            keep(study_file.collect(done[kind], rows, n, f"{mesh.name}, {kind}", keep))


def _summarise(part: dict[str, Any]) -> None:
    """Write the figures of each kind of scene beside its estimates."""
    from tools.studies.choices import study as choices

    for scene in part["scenes"].values():
        answers = {
            name: [choices.Timed(**study_file.numbers(each[name])) for each in scene["answers"]]
            for name in scene["answers"][0]
        }
        figures = choices.summarise(answers)
        scene["figures"] = figures
        scene["front"] = {
            "gain_mean": choices.front(figures, "gain_mean", 1),
            "mssd_mm_median": choices.front(figures, "mssd_mm_median", -1),
        }
        scene["beaten_by"] = choices.beaten_by(answers, figures)
        scene["ablations"] = choices.ablations(answers)


def _print(name: str, part: Mapping[str, Any]) -> None:
    headings = ["gain [nats]", "MSSD [mm]", "ms", "poses", "ready [s]"]
    for kind, scene in part["scenes"].items():
        rows = []
        for variant, f in scene["figures"].items():
            gain = "-" if f["gain_mean"] is None else f"{f['gain_mean']:.2f} ± {f['gain_standard_error'] or 0:.2f}"
            ms = f"{f['ms_quantiles'][1]:.1f} ({f['ms_quantiles'][0]:.1f}-{f['ms_quantiles'][2]:.1f})"
            ready = part["variants"][variant]["prepare_s"]
            numbers = [f"{part['variants'][variant]['poses']:,}", study_file.figure(ready, 0)]
            on_front = "*" if variant in scene["front"]["gain_mean"] else ""
            rows.append(
                [
                    variant + on_front,
                    part["variants"][variant]["choice"],
                    gain,
                    f"{f['mssd_mm_median']:.1f}",
                    ms,
                    *numbers,
                ]
            )
        typer.echo(f"{name}, {kind}; * Pareto-optimal in time and gain")
        print_table(["variant", "choice", *headings], rows, headings)
        if scene["beaten_by"]:
            typer.echo(f"the default is slower and gains less than: {', '.join(scene['beaten_by'])}")
        rows = [
            [what, "{:+.2f} ({:+.2f} to {:+.2f})".format(*f["gain"]), f"{f['time_ratio']:.2f}"]
            for what, f in scene["ablations"].items()
        ]
        if rows:
            print_table(["ablation", "gain [nats]", "time"], rows, ["gain [nats]", "time"])
