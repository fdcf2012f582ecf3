"""``geomtact next-touch``: which touch to make next, from a saved posterior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Seed
from geomtact.cli.shell import check_folder, posterior_file, print_table
from geomtact.errors import GeomtactError, InputError, nearest_name

if TYPE_CHECKING:
    from geomtact.inference.posterior import Posterior
    from geomtact.planning.actions import Probe, Touch
    from geomtact.planning.next_touch import Action

SCHEMA = "geomtact/next-touch/1"
_FIRST = 10  # actions on the screen
_KEYS = ("T_world_sensor", "travel", "cost", "probe")


def next_touch(
    posterior: Annotated[
        Path, typer.Argument(help="Current posterior: posterior.npz, or its folder.", show_default=False)
    ],
    actions: Annotated[
        Path | None, typer.Option(help="JSON of the touches and probes to rank. Default: touches from all around.")
    ] = None,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for next_touch.json and next_touch.png.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print only next_touch.json to standard output.")] = False,
    cache_dir: CacheDir = None,
) -> None:
    """Rank possible next touches by expected information gain per cost.

    The file of --actions holds {"actions": LIST}. A touch is {"T_world_sensor": 4x4, "travel": 0.1, "cost": 1}, a probe
    {"probe": {"point": XYZ, "direction": XYZ}}. All are in the posterior's frame, in metres.
    """
    from geomtact.inference.posterior import Posterior
    from geomtact.planning import next_touch as planning

    check_folder(out)
    given = None if actions is None else read_actions(actions)
    known = Posterior.load(posterior_file(posterior), cache_dir)
    ranked = planning.next_touch(known, given, seed=seed)
    note = planning.ambiguity(ranked)
    content = _content(
        known, ranked, note, {"posterior": str(posterior), "actions": actions and str(actions), "seed": seed}
    )
    if out is not None:
        _write(out, known, ranked, content, seed)
    if as_json:
        from geomtact.json_values import to_text

        typer.echo(to_text(content), nl=False)
        return
    typer.echo(f"{known.mesh.name} on {known.sensor.name}, {known.frame} frame; {len(ranked)} actions")
    right = ["", "expected gain [nats]", "discarded", "P(contact)", "cost"]
    headings = [right[0], "action", "from x, y, z [mm]", "along x, y, z", *right[1:]]
    print_table(headings, [_row(k + 1, a) for k, a in enumerate(ranked[:_FIRST])], right)
    if note is not None:
        typer.echo(note)
    typer.echo(f"written: {out}/next_touch.json and .png" if out else "for full poses and a figure, give --out DIR")


def read_actions(path: Path) -> list[Touch | Probe]:
    """Touches and probes of a JSON file.

    Raises
    ------
    InputError
        It cannot be read, is no such JSON, or holds an impossible action, which is named by its number from 1.
    """
    from geomtact.json_values import read_json

    try:
        entries = read_json(path)["actions"]
        if not isinstance(entries, list):
            raise TypeError
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({(error.strerror or str(error)).lower()}); give a JSON file"
        ) from None
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f'{path}: expected JSON {{"actions": [...]}} with touches and probes; see docs/formats.md'
        ) from None
    if not entries:
        raise InputError(f"{path}: no actions; add some, or leave --actions out for touches from all around")
    found = []
    for number, entry in enumerate(entries, 1):
        try:
            found.append(_action(entry))
        except GeomtactError as error:
            raise InputError(f"{path}: action {number}: {error}") from None
        except (TypeError, ValueError):
            raise InputError(f"{path}: action {number}: expected numbers: a pose of 4x4, metres, a cost") from None
    return found


def _action(entry: object) -> Touch | Probe:
    from geomtact.planning.actions import Probe, Touch

    if not isinstance(entry, Mapping) or ("T_world_sensor" in entry) == ("probe" in entry):
        raise InputError('expected either "T_world_sensor" (4x4) or "probe"; give one of them')
    for key in entry:
        if key not in _KEYS:
            raise InputError(f"unknown key {key!r}{nearest_name(key, _KEYS)}")
    cost = float(entry.get("cost", 1.0))
    if "T_world_sensor" in entry:
        return Touch(entry["T_world_sensor"], float(entry.get("travel", 0.0)), cost)
    probe = entry["probe"]
    if not isinstance(probe, Mapping) or set(probe) != {"point", "direction"}:
        raise InputError('a probe has a "point" and a "direction" of three numbers, and nothing else')
    return Probe(probe["point"], probe["direction"], cost)


def _content(
    posterior: Posterior, ranked: Sequence[Action], note: str | None, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """What goes into ``next_touch.json``."""
    from geomtact.json_values import plain
    from geomtact.versions import versions

    return plain(
        {
            "schema": SCHEMA,
            "object": {"name": posterior.mesh.name, "sha256": posterior.mesh.sha256, "unit": posterior.mesh.unit},
            "sensor": posterior.sensor.name,
            "frame": posterior.frame,
            "actions": [
                {
                    "number": action.number,
                    "kind": _kind(action),
                    "T_world_sensor": action.T_world_sensor,
                    "travel": getattr(action.of, "travel", None),
                    "expected_nats": action.expected_nats,
                    "expected_discarded": None if action.roughly else action.expected_discarded,
                    "contact": action.contact,
                    "cost": action.cost,
                    "roughly": action.roughly,
                }
                for action in ranked
            ],
            "note": note,
            "settings": settings,
            "versions": versions(),
        }
    )


def _write(out: Path, posterior: Posterior, ranked: Sequence[Action], content: Mapping[str, Any], seed: int) -> None:
    from geomtact.files import write_bytes, write_text
    from geomtact.json_values import to_text
    from geomtact.report.next_touch_plot import draw_next_touch

    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "next_touch.json", to_text(content))
    write_bytes(out / "next_touch.png", draw_next_touch(posterior, ranked, seed))


def _row(place: int, action: Action) -> list[str]:
    T = action.T_world_sensor
    return [
        str(place),
        f"{_kind(action)} {action.number}",
        ", ".join(f"{v:.1f}" for v in 1e3 * T[:3, 3] + 0.0),
        ", ".join(f"{v:.2f}" for v in T[:3, 2] + 0.0),
        f"{action.expected_nats:.2f}",
        f"{100 * action.expected_discarded:.0f} %",
        f"{100 * action.contact:.0f} %",
        f"{action.cost:g}",
    ]


def _kind(action: Action) -> str:
    return type(action.of).__name__.lower()
