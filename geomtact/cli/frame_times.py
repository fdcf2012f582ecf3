"""What speaks against the order of images by their names: numbers that do not sort, and when the files were written."""

from __future__ import annotations

import re
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

_SPREAD = 1.0  # s over which files are written one after the other at least, for their times to count
_STEADY = 0.25  # of the median time between two files that lies between all, if that is less than _SPREAD
_SECONDS = 10  # digits of the seconds since 1970
_DATE = re.compile(r"(?<![0-9])[0-9]{1,2}([-._])[0-9]{1,2}\1(?:19|20)[0-9]{2}(?![0-9])")


def misleading(paths: list[Path], numbers: list[tuple[str, ...]]) -> str | None:
    """Why images, ordered by the numbers in their names, may be in no order of time; None where nothing says so.

    Of ``numbers``, by which alone the names differ, each has its text in every name.
    """
    dates = {found[0] for path in paths if (found := _DATE.search(path.stem))}
    if len(dates) > 1:
        return f"dates with the year last, {' and '.join(sorted(dates)[:2])}, do not sort"
    counters = [column for column in numbers if "".join(column).isdigit()]
    for column in counters:
        if (why := _odd(column, follows=column is not numbers[0])) is not None:
            return why
    varying = [column for column in numbers if len(set(column)) > 1]
    if varying and varying[0] in counters:
        first, following = varying[0], counters[counters.index(varying[0]) + 1 :]
        if (why := _wrapped(first, following)) is not None:
            return why
        if len(varying) > 1 and _interleaved(first, varying[1]):
            return f"the numbers after {first[0]} and after {first[-1]} run alike, as of two cameras"
    return _written_otherwise(paths)


def _odd(column: tuple[str, ...], follows: bool) -> str | None:
    """What is odd about a number as a counter, where it ``follows`` another."""
    longest, shortest = max(column, key=len), min(column, key=len)
    # padded counters of n digits are not longer for a zero before them
    padded = max((number for number in column if number[0] == "0"), key=len, default="")
    if follows and len(padded) > len(shortest):
        return f"{padded} and {shortest} may be the digits after a point"
    if len(longest) > len(shortest) > _SECONDS and all(number[0] == "1" for number in column):
        return f"{longest} and {shortest} may be seconds and what follows them, not padded"
    return None


def _wrapped(column: tuple[str, ...], following: list[tuple[str, ...]]) -> str | None:
    """How a number may have started anew: it is at its least and its greatest, as of a counter or a clock, and not between."""
    numbers = sorted(set(column), key=int)
    low, high = numbers[0], numbers[-1]
    clock = bool(following) and _sixtieths(column + following[0])
    at_end = high in ("23", "59") if clock else len(high) > 2 and set(high) == {"9"}
    gap = max((int(b) - int(a) for a, b in pairwise(numbers)), default=0)
    if at_end and len(low) == len(high) and int(low) <= 1 and gap > int(high) / 2:
        return f"{high} may come before {low}, where a counter or a clock starts anew"
    return None


def _interleaved(first: tuple[str, ...], second: tuple[str, ...]) -> bool:
    """Whether at each of a few first numbers the same second ones come, more of them, as of cameras; on a clock they do too."""
    if _sixtieths(first + second):
        return False
    runs: dict[str, set[str]] = defaultdict(set)
    for one, other in zip(first, second, strict=True):
        runs[one].add(other)
    shortest = min(len(run) for run in runs.values())
    return shortest >= len(runs) and all(2 * len(a & b) > min(len(a), len(b)) for a, b in pairwise(runs.values()))


def _sixtieths(numbers: tuple[str, ...]) -> bool:
    """Whether numbers may be hours, minutes or seconds."""
    return all(len(number) == 2 and number < "60" for number in numbers)


def _written_otherwise(paths: list[Path]) -> str | None:
    """Which files were written in another order than by name, steadily, as a camera does, and not in the order of a copy."""
    try:
        written = {path: path.stat().st_mtime_ns * 1e-9 for path in paths}
    except OSError:
        return None
    by_time = sorted(paths, key=lambda path: written[path])
    if by_time == sorted(paths, key=lambda path: path.name):
        return None
    steps = sorted(written[b] - written[a] for a, b in pairwise(by_time))
    if sum(steps) <= _SPREAD or steps[0] <= min(_STEADY * steps[len(steps) // 2], _SPREAD):
        return None
    late = next(((a, b) for a, b in pairwise(paths) if written[a] > written[b]), None)
    return None if late is None else f"{late[0].name} was written after {late[1].name}"
