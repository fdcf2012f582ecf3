"""The JSON file of a study: kept up to date while the study runs, so that a stopped run goes on from there."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from geomtact.cli.shell import progress_bar, to_stderr

_SAVE_EVERY = 10  # touches
_LOGS = ("gain", "gains", "log_probability")  # fields of outcomes that are logs of probabilities


def load(out: Path | None, schema: str) -> dict[str, Any]:
    """What the file holds, or an empty study."""
    from geomtact.errors import InputError
    from geomtact.json_values import read_json

    if out is None or not out.exists():
        return {"schema": schema, "parts": {}}
    try:
        content = read_json(out)
        held = content["schema"]
        if any(not isinstance(part, dict) for part in content["parts"].values()):
            raise TypeError("a part that is no mapping")
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{out}: is there, but is no study of geomtact; give another file with --out") from None
    if held != schema:
        raise InputError(f"{out}: expected a study of the schema {schema}, got {held}; give another file with --out")
    return content


def earlier(entry: dict[str, Any] | None, settings: dict[str, Any], kind: Callable[..., Any] | None = None) -> list:
    """The outcomes, each a ``kind`` or as written, of an earlier run."""
    if entry is None or not begun(entry, settings):
        return []
    return outcomes(entry, kind) if kind is not None else entry.get("outcomes", [])


def begun(entry: dict[str, Any] | None, settings: dict[str, Any]) -> bool:
    """Whether there is an entry to go on with.

    Raises
    ------
    InputError
        It was made with other settings: what it holds is not overwritten.
    """
    import json

    from geomtact.errors import InputError
    from geomtact.evaluation import changed
    from geomtact.json_values import plain

    if entry is None:
        return False
    held, wanted = entry.get("settings", {}), json.loads(json.dumps(plain(settings)))
    if other := changed(held, wanted):
        raise InputError(
            f"--out holds a study of {settings.get('object', 'this part')} with other settings ({', '.join(other)}); give "
            "another file, or the same settings to go on with it"
        )
    return True


def outcomes(entry: dict[str, Any], kind: Callable[..., Any]) -> list:
    """The outcomes of an entry, each a ``kind``, those that were made together one after the other."""
    rows = (row if isinstance(row, list) else [row] for row in entry["outcomes"])
    return [kind(**numbers(each)) for row in rows for each in row]


def numbers(outcome: Mapping[str, Any]) -> dict[str, Any]:
    """An outcome as written; null stands for what JSON has no number for: the log of no probability, an infinitely wrong pose."""
    return {key: _number(value, -math.inf if key in _LOGS else math.inf) for key, value in outcome.items()}


def _number(value: Any, null: float) -> Any:
    """A value as written, ``null`` in the place of each null in it."""
    if isinstance(value, dict):
        return {key: _number(each, null) for key, each in value.items()}
    if isinstance(value, list):
        return [_number(each, null) for each in value]
    return null if value is None else value


def collect(done: list, more: Iterable, total: int, title: str, keep: Callable[[list], None]) -> list:
    """The outcomes ``done`` and ``more``, ``total`` in all, under a progress bar; ``keep`` is called every few."""
    with progress_bar(title) as progress:
        for outcome in more:
            done.append(outcome)
            progress(len(done) / total, "")
            if len(done) % _SAVE_EVERY == 0:
                keep(done)
    return done


def judged(
    out: Path | None,
    content: dict[str, Any],
    settings: Mapping[str, Any],
    total: int,
    doing: str,
    more: Callable[[int], Iterable[Any]],
    kind: Callable[..., Any] | None = None,
    summarise: Callable[[list], Any] | None = None,
) -> None:
    """Bring the outcomes of the part that ``settings`` describe to ``total``, in ``content`` and in the file.

    ``more`` makes those from a number on, each a dataclass ``kind`` or several of them; what ``summarise`` makes of all goes
    beside them.
    """
    name = settings["object"]
    done = earlier(content["parts"].get(name), dict(settings))

    def put(rows: list) -> None:
        figures = {"figures": summarise(outcomes({"outcomes": rows}, kind))} if kind and summarise else {}
        keep(out, content, name, settings=settings, **figures, outcomes=rows)

    if len(done) < total:
        collect(done, map(_flat, more(len(done))), total, f"{doing} {name}", put)
    put(done)
    to_stderr(f"{name}: done")


def _flat(outcome: Any) -> Any:
    """A dataclass as a mapping, each of several as one."""
    return [_flat(each) for each in outcome] if isinstance(outcome, list | tuple) else asdict(outcome)


def keep(out: Path | None, content: dict[str, Any], part: str, **entry: Any) -> None:
    """Put what is known of a part into ``content``, and that into the file."""
    from geomtact.json_values import plain

    content["parts"][part] = plain(entry)
    save(out, content)


def save(out: Path | None, content: dict[str, Any]) -> None:
    """Write ``content``, with the versions of what made it, if there is a file to write."""
    from geomtact.files import write_text
    from geomtact.json_values import to_text
    from geomtact.versions import versions

    content["versions"] = versions()
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        text = to_text(content)
        write_text(out, text)


def plot(content: Mapping[str, Any], path: Path | None, which: str | None = None) -> None:
    """Write the picture of a study as PNG, if there is a file to write; ``which`` as of ``report.studies.draw``."""
    from geomtact.files import write_bytes
    from tools.studies.common.pictures import draw

    if path is not None:
        picture = draw(content, which)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, picture)


def figure(value: float | None, digits: int = 2, sign: str = "-") -> str:
    """``value`` as text, or a dash where there is none: what is known of another part, the time of what lay in the cache."""
    return "-" if value is None else f"{value:{sign}.{digits}f}"


def percent(share: float | None) -> str:
    """A share as text, or a dash where there is none."""
    return "-" if share is None else f"{100 * share:.0f} %"


def length(mm: float | None) -> str:
    """A length of a study's figures as text; null stands for infinity."""
    return "inf" if mm is None else f"{mm:.1f}"


def masses() -> list[str]:
    """Headings of :func:`inside`."""
    from geomtact.evaluation import LEVELS

    return [f"in {100 * mass:.0f} %" for mass in LEVELS]


def inside(figures: Mapping[str, Any]) -> list[str]:
    """Percentage of truths inside the region of each mass, with its interval."""
    return [f"{100 * c['share']:.0f} ({100 * c['low']:.0f}-{100 * c['high']:.0f})" for c in figures["coverage"]]
