"""Where options come from that the user left out: the nearest ``geomtact.toml``, then the image's own metadata."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

from geomtact.errors import InputError, UsageError, nearest_name
from geomtact.files import read_text

FILE = "geomtact.toml"
KEYS = ("object", "unit", "sensor", "background", "effort")


def resolve(
    given: Mapping[str, str | None], metadata: Mapping[str, str] | None = None, start: Path | None = None
) -> tuple[dict[str, str | None], dict[str, str]]:
    """Fill in what was not given.

    Parameters
    ----------
    given : options by their name in ``KEYS``; None means not given
    metadata : of the image: its ``geomtact:object``, ``geomtact:unit`` and ``geomtact:sensor`` serve last
    start : folder from which ``geomtact.toml`` is looked for upwards; by default the current one

    Returns
    -------
    values : the options, None where none of these gives one
    sources : where each one that was filled in comes from

    Notes
    -----
    A unit belongs to the object that it is given with: the file's does not apply to an object of the command line, nor
    the image's to any other object.
    """
    values, sources = dict(given), {}
    path = find(start or Path.cwd())
    if path is not None:
        entries = read(path)
        if values.get("object") is not None and "object" in entries:
            entries.pop("unit", None)
        for key, value in entries.items():
            if key in values and values[key] is None:
                values[key], sources[key] = value, str(path)
    stated = {key: (metadata or {}).get(f"geomtact:{key}") for key in ("object", "unit", "sensor")}
    if values.get("object") is not None:
        stated["unit"] = None
    for key, found in stated.items():
        if key in values and values[key] is None and found:
            values[key], sources[key] = found, "the image's metadata"
    return values, sources


def required(values: Mapping[str, str | None], object_given: str | None = None) -> tuple[str, str]:
    """The object and the sensor; ``object_given`` is how the command line names the object, if not by --object.

    Raises
    ------
    UsageError
        One is missing; its choices are listed.
    """
    from geomtact.geometry.catalogue import catalogue
    from geomtact.sensing.sensor import bundled_sensors

    object_name, sensor = values.get("object"), values.get("sensor")
    if object_name is None or sensor is None:
        missing, given, choices, other = "sensor", "--sensor NAME", bundled_sensors(), "a TOML file"
        if object_name is None:
            missing, given = "object", object_given or "--object NAME"
            choices, other = list(catalogue()), "a mesh file with --unit"
        raise UsageError(
            f"no {missing} given; give {given}, one of {', '.join(choices)}; or {other}; or set {missing} in {FILE}"
        )
    return object_name, sensor


def find(start: Path) -> Path | None:
    """The nearest ``geomtact.toml`` in ``start`` or above."""
    start = start.resolve()
    return next((folder / FILE for folder in (start, *start.parents) if (folder / FILE).is_file()), None)


def read(path: Path) -> dict[str, str]:
    """The entries of a ``geomtact.toml``; files named in it are relative to its own folder, or to the home folder behind a ~.

    Raises
    ------
    InputError
        Not valid TOML, an unknown key (the nearest is named), or an entry that is no text.
    """
    try:
        entries = tomllib.loads(read_text(path))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error}); correct or remove it") from None
    for key, value in entries.items():
        if key not in KEYS:
            raise InputError(f"{path}: unknown key {key!r}{nearest_name(key, KEYS)}")
        if not isinstance(value, str):
            raise InputError(f"{path}: {key} must be text in quotes, got {value!r}")
        if not value.strip():
            raise InputError(f"{path}: {key} is empty; give a value, or remove the line")
        if key in ("object", "sensor", "background") and not is_bundled(key, value):
            # an object or a sensor may be a name; an image is a file
            beside = path.parent / _home(value)
            is_there = beside.is_file() or (key == "object" and beside.is_dir())
            entries[key] = str(beside) if is_there or key == "background" else value
    return entries


def _home(path: str) -> Path:
    """A path with the home folder in the place of ~; as it is where there is none."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def is_bundled(key: str, name: str) -> bool:
    """Whether ``name`` is that of a bundled object or sensor, which ``key`` says: a file of the same name stands behind it."""
    from geomtact.geometry.catalogue import catalogue
    from geomtact.sensing.sensor import bundled_sensors

    return name in catalogue() if key == "object" else key == "sensor" and name in bundled_sensors()
