"""Make parts of mesh files: repaired, proved to be where they were, in a known unit, ready to be localized.

    python tools/prep_mesh.py IN... --unit mm --out DIR        # repair; a folder stands for the meshes in it
    python tools/prep_mesh.py part.step --add-to meshes/       # and use it from then on as --object part

For each file DIR gets NAME.ply (the mesh, in the file's own unit and frame), NAME.png (before and after) and NAME.json (what was
done and measured). A mesh that cannot be repaired within the bounds is refused, with the reason, and nothing of it is written.
Needs the extra meshprep (pymeshlab, GPL-3), for STEP files also the extra step.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

sys.path.insert(0, str(Path(__file__).resolve().parent))

SECONDS, BYTES = 60.0, 4_000_000_000  # that a file may take
SCHEMA = "geomtact/mesh-prep/1"


def main(
    inputs: Annotated[list[Path], typer.Argument(metavar="IN...", help="Mesh or CAD files, or folders of them.")],
    unit: Annotated[
        str | None, typer.Option(help="mm, cm, m or inch, for files that do not say; auto: proposals.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("out/meshes"),
    max_deviation: Annotated[float, typer.Option(min=0, help="By how much the surface may move [mm].")] = 0.05,
    max_hole: Annotated[float, typer.Option(min=0, help="Span of the largest hole that is filled [mm].")] = 5.0,
    max_faces: Annotated[int, typer.Option(min=12, help="Faces beyond which a mesh is made coarser.")] = 200_000,
    merge: Annotated[
        float | None, typer.Option(min=0, help="Distance below which corners are one, in the file's unit.")
    ] = None,
    skip: Annotated[list[str] | None, typer.Option(help="A step to leave out; may be given again.")] = None,
    largest: Annotated[bool, typer.Option("--largest", help="Keep the largest body alone.")] = False,
    split: Annotated[bool, typer.Option("--split", help="Make a part of each body.")] = False,
    symmetry: Annotated[float, typer.Option(min=0, help="Tolerance of the symmetry [mm].")] = 0.05,
    sensor: Annotated[
        str, typer.Option(help="By whose window units are proposed and ambiguity is judged.")
    ] = "gelslim",
    ambiguity: Annotated[
        bool, typer.Option("--ambiguity", help="Draw how ambiguous a touch is, all over the object.")
    ] = False,
    add_to: Annotated[
        Path | None, typer.Option(help="Folder to whose catalogue the objects are added: meshes/ of this checkout.")
    ] = None,
    description: Annotated[str, typer.Option(help="Of the object, for the catalogue.")] = "",
    licence: Annotated[str, typer.Option(help="Of the object, for the catalogue.")] = "unknown",
    as_json: Annotated[bool, typer.Option("--json", help="Print all results as JSON, and nothing else there.")] = False,
) -> None:
    """Repair meshes, prove what that changed, and say in which unit and with which symmetry they are objects."""
    from meshprep.reading import states_own_unit
    from meshprep.repair import STEPS

    unknown = sorted(set(skip or ()) - set(STEPS))
    if unknown:
        raise typer.BadParameter(
            f"no step named {', '.join(unknown)}; steps are {', '.join(STEPS)}", param_hint="--skip"
        )
    files = _files(inputs, out)
    if not files:
        raise typer.BadParameter("no mesh files there", param_hint="IN")
    names = _names(files)
    over = {(out / f"{name}.ply").resolve() for name in names} & {file.resolve() for file in files}
    if over:
        raise typer.BadParameter(f"{over.pop()} would be written over; give another folder", param_hint="--out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(f"{out} cannot be made a folder ({error.strerror})", param_hint="--out") from None
    options = {
        "unit": unit,
        "max_deviation_mm": max_deviation,
        "max_hole_mm": max_hole,
        "max_faces": max_faces,
        "merge": merge,
        "skip": sorted(skip or ()),
        "largest": largest,
        "split": split,
        "symmetry_mm": symmetry,
        "sensor": sensor,
        "add_to": None if add_to is None else str(add_to),
        "description": description,
        "licence": licence,
        "taken": names,
        "of_several": not all(states_own_unit(file) for file in files if file.is_file()),
    }
    results = []
    for file, name in zip(files, names, strict=True):
        result = _bounded(file, name, out, options)
        results.append(result)
        if ambiguity and result["outcome"] != "refused":
            _draw_ambiguity(result, out, sensor)
        typer.echo(f"{file}: {_said(result)}", err=True)
    if as_json:
        from geomtact.json_values import plain

        typer.echo(json.dumps({"schema": SCHEMA, "meshes": plain(results)}, indent=1))
    else:
        _table(results)
    if made := [result for result in results if result["outcome"] != "refused"]:
        typer.echo(_next(made[0], out, add_to is not None, sensor), err=True)
    raise typer.Exit(3 if all(result["outcome"] == "refused" for result in results) else 0)


def prepare(file: Path, name: str, out: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Read, repair, prove and write one file; what came of it."""
    from meshprep import Refused
    from meshprep.reading import read
    from meshprep.repair import Options, repair
    from meshprep.writing import write

    from geomtact.errors import GeomtactError
    from geomtact.geometry.units import UNITS
    from geomtact.sensing.sensor import Sensor

    result: dict[str, Any] = {"file": str(file), "name": name, "outcome": "refused", "reason": None}
    try:
        surface, unit = read(file, options["unit"], Sensor.load(options["sensor"]), options["of_several"])
        mm = 1e3 * UNITS[unit]  # millimetres in the file's unit
        result |= {"unit": unit, "sha256": hashlib.sha256(file.read_bytes()).hexdigest(), "size_mm": mm * surface.size}
        allowed = Options(
            frozenset(options["skip"]),
            options["merge"] if options["merge"] is not None else 1e-6 * surface.size,
            options["max_hole_mm"] / mm,
            options["max_faces"],
            0.5 * options["max_deviation_mm"] / mm,
            options["largest"],
        )
        result |= write(surface, repair(surface, allowed), name, unit, out, options)
    except (Refused, GeomtactError) as error:
        result |= {"outcome": "refused", "reason": str(error).removeprefix(f"{file}: ")}
    except OSError as error:
        result |= {"outcome": "refused", "reason": f"cannot be read, or its results not written ({error})"}
    except Exception as error:  # noqa: BLE001 -- pymeshlab and readers fail in more ways than can be listed
        words = f"{type(error).__name__}: {' '.join(str(error).split())[:150]}"
        result |= {"outcome": "refused", "reason": f"its repair failed ({words}); repair it in a mesh editor first"}
    return result


def _draw_ambiguity(result: dict[str, Any], out: Path, sensor: str) -> None:
    """Beside each object's mesh a picture of the expected gain of a touch there; an index is built for it, about a minute."""
    from meshprep.ambiguity import draw_ambiguity

    from geomtact.files import write_bytes
    from geomtact.geometry.mesh_file import load_mesh

    for part in result["parts"]:
        drawn = draw_ambiguity(load_mesh(out / f"{part}.ply", result["unit"]), sensor)
        write_bytes(out / f"{part}_ambiguity.png", drawn)


def _bounded(file: Path, name: str, out: Path, options: dict[str, Any]) -> dict[str, Any]:
    """:func:`prepare` in a separate process, which may crash, hang or grow without harm."""
    began = time.monotonic()
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    worker = context.Process(target=_work, args=(there, file, name, out, options))
    worker.start()
    there.close()
    reason, result = None, None
    while True:
        if here.poll(0.05):
            try:
                result = here.recv()
            except EOFError:
                reason = "reading or repairing it crashed; repair it in a mesh editor first"
            break
        if time.monotonic() - began > SECONDS:
            reason = f"it takes more than {SECONDS:.0f} s; make it coarser first"
        elif _resident(worker.pid) > BYTES:
            reason = f"it takes more than {BYTES / 1e9:.0f} GB of memory; make it coarser first"
        if reason:
            break
    worker.terminate() if reason else None
    worker.join()
    if result is None:
        result = {"file": str(file), "name": name, "outcome": "refused", "reason": reason}
    if result["outcome"] == "refused":  # nothing of an earlier run may pass for its result
        for suffix in (".ply", ".png") if (out / f"{name}.json").is_file() else ():
            (out / f"{name}{suffix}").unlink(missing_ok=True)
        (out / f"{name}.json").unlink(missing_ok=True)
    return result | {"seconds": round(time.monotonic() - began, 2)}


def _work(pipe: Any, file: Path, name: str, out: Path, options: dict[str, Any]) -> None:
    pipe.send(prepare(file, name, out, options))


def _resident(pid: int | None) -> int:
    """Bytes of memory that a process holds; 0 where that is unknown."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))
    except (OSError, StopIteration):
        return 0


def _files(inputs: Sequence[Path], out: Path) -> list[Path]:
    """The files to be prepared; of folders all meshes in them, but for hidden ones and the results of an earlier run."""
    from meshprep.reading import FORMATS

    files: list[Path] = []
    for each in inputs:
        below = (p for p in each.rglob("*") if not any(name.startswith(".") for name in p.relative_to(each).parts))
        inside = sorted(p for p in below if p.suffix.lower() in FORMATS) if each.is_dir() else [each]
        files += [p for p in inside if p == each or out.resolve() not in p.resolve().parents]
    return files


def _names(files: Sequence[Path]) -> list[str]:
    """The stem of each file, numbered where it is taken."""
    from geomtact.files import printable

    names: list[str] = []
    stems = [printable(file.stem) for file in files]
    for stem in stems:
        name, k = stem, 1
        while name in names or (k > 1 and name in stems):
            k += 1
            name = f"{stem}_{k}"
        names.append(name)
    return names


def _said(result: dict[str, Any]) -> str:
    if result["outcome"] == "refused":
        return f"refused: {result['reason']}"
    told = [f"{step}: {words}" for step, words in result["changes"].items()]
    changes = "; ".join(told + [f"warning: {words}" for words in result["warnings"]])
    return f"{result['outcome']}, in {result['unit']}{': ' if changes else ''}{changes}"


def _next(result: dict[str, Any], out: Path, named: bool, sensor: str) -> str:
    """The command that localizes the first of a file's objects, by its name in the catalogue or by its file."""
    part = result["parts"][0]
    which = part if named else f"{shlex.quote(str(out / f'{part}.ply'))} --unit {result['unit']}"
    return f"next: geomtact localize IMAGE --object {which} --sensor {shlex.quote(sensor)}"


def _short(reason: str) -> str:
    return reason if len(reason) <= 70 else reason[:69] + "…"


def _table(results: Sequence[dict[str, Any]]) -> None:
    from geomtact.cli.shell import print_table

    rows = []
    for r in results:
        row = [r["name"], r["outcome"], f"{r['seconds']:.1f}"]
        if r["outcome"] != "refused":
            holes = str(len(r["holes"]))
            row += [r["unit"], f"{r['deviation_mm']:.4f}", holes, str(r["faces"]), r["symmetry"]["kind"], ""]
        else:
            row += ["", "", "", "", "", _short(str(r["reason"]))]
        rows.append(row)
    headings = ("mesh", "outcome", "s", "unit", "deviation [mm]", "holes", "faces", "symmetry", "why")
    print_table(headings, rows, ("s", "deviation [mm]", "holes", "faces"))


if __name__ == "__main__":
    from geomtact.cli.shell import claim_output

    claim_output()
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(main)
    app()
