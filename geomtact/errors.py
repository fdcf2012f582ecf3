"""What geomtact raises: each message says what was expected, what was given and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import PurePath


class GeomtactError(Exception):
    """Base class of every error that geomtact raises on purpose."""


class UsageError(GeomtactError):
    """An option or a name is missing, unknown or contradicts another (exit status 2)."""


class InputError(GeomtactError):
    """A file or an array cannot be used as it is (exit status 3)."""


class MeshError(InputError):
    """A mesh cannot be used: unreadable, without unit, open, or of another scale than the sensor."""


class ImageError(InputError):
    """An image cannot be used: unreadable, of another size than the sensor, or of none of the kinds."""


class SensorError(InputError):
    """A sensor description has a missing, unknown or impossible entry."""


class PoseError(InputError):
    """An array that should hold rigid transforms does not."""


class NoPoseAgreesError(InputError):
    """No pose of the object agrees with what all sensors show."""


class CacheError(InputError):
    """The cache folder cannot be read or written."""


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """``"; did you mean 'x'?"`` for the one of ``names`` nearest to ``name``, ``""`` if none is near."""
    stems = {_stem(each): each for each in sorted(names, reverse=True)}
    close = difflib.get_close_matches(_stem(name), sorted(stems), n=1)
    return f"; did you mean {stems[close[0]]!r}?" if close else ""


def _stem(name: str) -> str:
    """What distinguishes one name from another: neither case nor a file's suffix."""
    return PurePath(name).stem.lower()


def nearest_name(name: str, names: Iterable[str]) -> str:
    """:func:`did_you_mean`, and the list of names."""
    names = sorted(names)
    return f"{did_you_mean(name, names)} (known: {', '.join(names)})"
