"""``python -m tools.studies scores``: gain and cost of scores on the same touches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Effort, MaxPoses, Seed, Unit
from geomtact.cli.shell import print_table, progress_bar, to_stderr
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

if TYPE_CHECKING:
    from geomtact.geometry.mesh import Mesh
    from geomtact.sensing.sensor import Sensor

SCHEMA = "geomtact/scores/2"


@dataclass(frozen=True)
class Options:
    """What a study's figures depend on, beside the objects and the scores: ``felt`` is one of ``touches.GEL_KINDS``, ``only`` a
    class of contact or None for all."""

    sensor: Sensor
    touches: int
    noise: str
    felt: str
    effort: str
    seed: int
    max_poses: int
    only: str | None

    def __str__(self) -> str:
        kind = f"{self.only} " if self.only else ""
        return f"{self.touches} {kind}touches on {self.sensor.name}, {self.felt}, {self.noise} noise"

    def settings(self) -> dict[str, Any]:
        """As they stand in the file."""
        strength = study_options.noise_named(self.noise)
        named: dict[str, Any] = {"sensor": self.sensor.name, "noise": {"name": self.noise, **asdict(strength)}}
        if self.only:
            named["only"] = self.only
        return named | {key: getattr(self, key) for key in ("touches", "felt", "effort", "seed", "max_poses")}


def sort_words(words: Sequence[str], scores: Sequence[str]) -> tuple[list[str], list[str]]:
    """The objects and the scores that the command line names; by default the thesis's four objects, and all scores.

    An option takes one word, so of ``--scores l1 iou`` the second comes among ``words``, with the objects.

    Raises
    ------
    UsageError
        No score of that name, or neither a score nor an object.
    """
    from geomtact.errors import UsageError, nearest_name
    from geomtact.geometry.catalogue import catalogue
    from geomtact.inference.effort import EFFORTS
    from geomtact.scoring.catalogue import SCORERS
    from tools.studies.common.study import THESIS_PARTS

    known = (*SCORERS, *EFFORTS)
    for name in scores:
        if not _is_score(name, known):
            raise UsageError(f"no score named {name!r}{nearest_name(name, known)}")
    more = [word for word in words if scores and _is_score(word, known)]
    parts = [word for word in words if word not in more]
    for word in parts:
        if scores and word not in catalogue() and not Path(word).suffix:
            raise UsageError(f"no score or part named {word!r}{nearest_name(word, [*known, *catalogue()])}")
    every = [*SCORERS, *EFFORTS]
    return parts or list(THESIS_PARTS), list(dict.fromkeys([*scores, *more])) or every


def words_meant(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options, with the objects and the scores that :func:`sort_words` makes of them."""
    parts, scores = sort_words(options["parts"] or [], options["scores"] or [])
    return {**options, "parts": parts, "scores": scores}


def _is_score(name: str, known: Sequence[str]) -> bool:
    return name in known or Path(name).suffix == ".safetensors"


def judge_scores(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    scores: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCORE...",
            help="Scores to judge, by name or weights file; fast, balanced or exact is the default score at that effort.",
        ),
    ] = None,
    sensor: study_options.SensorName = "gelslim",
    touches: Annotated[int, typer.Option("--touches", min=1, help="How many touches of each object.")] = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    felt: study_options.Felt = study_options.FeltName.elastic,
    effort: study_options.EffortLevel = Effort.balanced,
    seed: Seed = 1,
    max_poses: MaxPoses = None,
    only: study_options.Only = None,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge scores, all by default, side by side on the same touches: their gain and their cost.

    Prints gain, coverage, pose errors and times of each, and writes them and every outcome to --out.
    """
    from geomtact.contact_space.resolution import MAX_POSES
    from geomtact.json_values import plain
    from geomtact.sensing.sensor import Sensor

    chosen, names = sort_words(parts or [], scores or [])
    options = Options(
        sensor=Sensor.load(sensor),
        touches=touches,
        noise=noise.value,
        felt=felt.value,
        effort=effort.value,
        seed=seed,
        max_poses=max_poses or MAX_POSES,
        only=only and only.value,
    )
    content = study_file.load(out, SCHEMA)
    settings = plain(options.settings())
    if not study_file.begun(content if "settings" in content else None, settings):
        content["settings"] = settings
    content.pop("overall", None)
    for mesh in study_options.meshes(chosen, unit, options.sensor):
        part = _part(content, mesh, options.sensor)
        made: list = []  # touches, when first needed, and the same ones for every score
        for name in names:
            _judge(part, mesh, name, options, made, lambda: study_file.save(out, content), cache_dir)
            _compare(part, options.touches)
        _print(f"{mesh.name}: {options}", part["scores"])
    content["overall"] = plain(_overall(content["parts"]))
    content["classes"] = plain(_by_class(content["parts"]))
    study_file.save(out, content)
    tables = {name: part["scores"] for name, part in content["parts"].items()}
    if len(tables) > 1:
        tables["overall"] = content["overall"]
        _print(f"mean over {', '.join(content['parts'])}", content["overall"])
    _print_coverage(tables)
    _print_classes(content["classes"])
    study_file.plot(content, plot)


def _part(content: dict[str, Any], mesh: Mesh, sensor: Sensor) -> dict[str, Any]:
    """What the file holds of the object on the sensor, or room for it."""
    pressed = {"object_sha256": mesh.sha256, "sensor_sha256": sensor.sha256}
    part = content["parts"].setdefault(mesh.name, {**pressed, "index_s": None, "random_add_mm": None, "scores": {}})
    held = {key: part[key] for key in pressed}
    study_file.begun({"settings": {"object": mesh.name, **held}}, {"object": mesh.name, **pressed})
    return part


def _judge(
    part: dict[str, Any],
    mesh: Mesh,
    name: str,
    options: Options,
    touches: list,
    save: Callable[[], None],
    cache_dir: Path | None,
) -> None:
    """Judge one score on one object, from where the file ends."""
    from geomtact.contact_space.touches import GEL_KINDS
    from geomtact.evaluation import describe
    from geomtact.inference.effort import EFFORTS
    from geomtact.json_values import plain
    from geomtact.scoring.catalogue import DEFAULT_SCORER
    from tools.studies.common import study
    from tools.studies.scores import study as scores

    # the name of an effort stands for the default score at that effort
    scorer, effort = (DEFAULT_SCORER, name) if name in EFFORTS else (name, options.effort)
    with progress_bar(f"preparing {mesh.name}, {name}") as progress:
        localizer, times = scores.prepare(mesh, options.sensor, scorer, options.max_poses, cache_dir, progress)
    described = plain(describe(localizer))
    found = part["scores"].get(name)
    outcomes = study_file.earlier(found, described, scores.Scored)
    known = {**(found["prepare_s"] if found else {}), "index": part["index_s"]}
    seconds = {step: known.get(step) if s is None else s for step, s in asdict(times).items()}
    part["index_s"] = seconds["index"]
    part["random_add_mm"] = part["random_add_mm"] or study.expected_random_add(localizer)

    def keep(outcomes: list) -> None:
        entry = {
            "settings": described,
            "bytes_per_pose": scores.bytes_per_pose(localizer.scorer.scorer, localizer.index),
            "prepare_s": seconds,
            "outcomes": [asdict(o) for o in outcomes],
        }
        part["scores"][name] = plain(entry)
        save()

    if len(outcomes) < options.touches and not touches:
        elastic, strength = GEL_KINDS[options.felt], study_options.noise_named(options.noise)
        touches += study.make_touches(
            localizer.space, options.touches, options.seed, strength, elastic=elastic, only=options.only
        )
    todo = scores.judged(localizer, touches[len(outcomes) :], effort, options.seed)
    keep(study_file.collect(outcomes, todo, options.touches, f"judging {mesh.name}, {name}", keep))
    to_stderr(f"{mesh.name}, {name}: done")


def _compare(part: dict[str, Any], n: int) -> None:
    """Write the figures of those of an object's scores that have all ``n`` touches, beside their outcomes."""
    from geomtact.json_values import plain
    from tools.studies.scores import study as scores

    outcomes = {name: study_file.outcomes(entry, scores.Scored) for name, entry in part["scores"].items()}
    done = {name: some for name, some in outcomes.items() if len(some) == n}
    for name, some in done.items():
        figures = scores.summarise(some, done.get("iou", []), part["random_add_mm"])
        part["scores"][name]["figures"] = plain(figures)


def _overall(parts: Mapping[str, Any]) -> dict[str, Any]:
    """The figures over all objects, of those scores that have been judged on each."""
    from tools.studies.scores import study as scores

    entries = [part["scores"] for part in parts.values()]
    return {
        name: scores.over_parts(
            [some[name] for some in entries], [study_file.outcomes(some[name], scores.Scored) for some in entries]
        )
        for name in _on_each(entries)
    }


def _on_each(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """The scores that have been judged on each object."""
    return [name for name in entries[0] if all("figures" in some.get(name, {}) for some in entries)]


def _by_class(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Gain and coverage by contact class, of those scores that have been judged on each object."""
    from tools.studies.common import study
    from tools.studies.scores import study as scores

    entries = [part["scores"] for part in parts.values()]
    return {
        name: study.by_class([o for some in entries for o in study_file.outcomes(some[name], scores.Scored)])
        for name in _on_each(entries)
    }


def _print_classes(classes: Mapping[str, Mapping[str, Any]]) -> None:
    """Gain and coverage of each score by the kind of contact."""
    rows = []
    for name, kinds in classes.items():
        for kind, f in kinds.items():
            rows.append([name, kind, str(f["n"]), study_file.figure(f["gain_mean"], 2), *study_file.inside(f)])
    masses = study_file.masses()
    typer.echo("By kind of contact: percentage of truths inside the region of each mass, with 99 % intervals")
    print_table(["score", "contact", "n", "gain [nats]", *masses], rows, ["n", "gain [nats]", *masses])


def _print(title: str, entries: Mapping[str, Any]) -> None:
    """A table of the gain and cost of each score: bytes are those of a pose, ready is after the index, the description
    of its contacts and the calibration."""
    headings = ["gain [nats]", "claimed", "over iou", "MSSD [mm]", "of 10", "in 50/80/90/95 %", "worst"]
    headings += ["score [ms]", "localize [ms]", "bytes", "ready [s]"]
    rows = []
    for name, entry, f in _groups(entries):
        seconds = entry["prepare_s"].values()
        row = [
            _with_error(f["gain_mean"], f["gain_standard_error"]),
            study_file.figure(f["claimed_mean"], 2),
            _with_error(f["over_iou_mean"], f["over_iou_standard_error"], "+"),
            study_file.figure(f["mssd_mm_median"], 1),
            study_file.figure(f["mssd10_mm_median"], 1),
            "/".join(f"{100 * c['share']:.0f}" for c in f["coverage"]),
            f"{100 * f['coverage_error']:.0f}",
            study_file.figure(f["score_ms_median"], 1),
            study_file.figure(f["ms_median"], 1),
            study_file.figure(entry["bytes_per_pose"], 0),
            study_file.figure(None if None in seconds else sum(seconds), 1),
        ]
        rows.append([name, *row])
    typer.echo(title)
    print_table(["score", *headings], rows, headings)


def _print_coverage(tables: Mapping[str, Mapping[str, Any]]) -> None:
    """The coverage of all ``tables`` (entries by title) with its intervals."""
    rows = []
    for title, entries in tables.items():
        for name, _, f in _groups(entries):
            rows.append([title, name, str(f["n"]), *study_file.inside(f)])
    typer.echo("Percentage of truths inside the region of each mass, with 95 % intervals")
    masses = study_file.masses()
    print_table(["part", "score", "n", *masses], rows, ["n", *masses])


def _groups(entries: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any], Mapping[str, Any]]]:
    """Name, entry and figures of every score that is done; touches of two kinds have a row each below those of all."""
    return [
        (name if group == "all" else f"  {group}", entry, f)
        for name, entry in entries.items()
        for group, f in entry.get("figures", {}).items()
        if group == "all" or len(entry["figures"]) > 2
    ]


def _with_error(value: float | None, error: float | None, sign: str = "-") -> str:
    return study_file.figure(value, 2, sign) + ("" if None in (value, error) else f" ± {error:.2f}")
