"""The order of images by their names: numbers in them by value; and what speaks against that order."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

# A number in a name: two joined by one point or comma are one, 1.25, but three are three, as in a date. Ten digits that begin
# with 1 are seconds since 1970: what follows them after _ or - is joined to them too.
_NUMBER = re.compile(
    r"((?<![0-9])1[0-9]{9}[_-][0-9]+|(?<![0-9])(?<![0-9][.,])[0-9]+[.,][0-9]+(?![0-9])(?![.,][0-9])|[0-9]+)"
)
_DIGITS = 17  # that Python writes a float with at most, zeros before them aside
_SHOWN = 3  # names of the order taken that a warning gives
_SPREAD = 1.0  # s over which files are written one after the other at least, for their times to count
_STEADY = 0.25  # of the median time between two files that lies between all, if that is less than _SPREAD
_SECONDS = 10  # digits of the seconds since 1970
_DATE = re.compile(r"(?<![0-9])[0-9]{1,2}([-._])[0-9]{1,2}\1(?:19|20)[0-9]{2}(?![0-9])")

Key = list[str | tuple[Decimal, int]]
Column = tuple[tuple[str, ...], int]  # the texts around the numbers of a name, and the place of one of these


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Images by name, numbers in it by value: 2 before 10, and 1.25 before 1.5.

    Numbers joined by a point are decimals; but where their names have what decimals never end in, 0, or more digits than a float
    has, they are two counters: 1.9 before 1.10.
    """
    paths = list(paths)
    keys, _ = _keys(paths)
    return sorted(paths, key=lambda path: (keys[path], path.name))


def doubt(paths: list[Path]) -> str | None:
    """What the names of images :func:`in_order` leave open, in a line; None where they settle the order."""
    why = _unsettled(paths)
    if why is None:
        return None
    shown = ", ".join(path.name for path in paths[:_SHOWN]) + (", ..." if len(paths) > _SHOWN else "")
    return (
        f"the names do not settle the order of the images: {why}; the order used is {shown}; for another, give - as "
        "the source and write the paths to standard input"
    )


def _unsettled(paths: list[Path]) -> str | None:
    """Why the order of images by their names is not sure."""
    keys, unsure = _keys(paths)
    for path, following in pairwise(paths):
        if keys[path] == keys[following]:
            return f"{path.name} and {following.name} have the same number"
        if keys[path][::2] != keys[following][::2]:
            return f"{path.name} and {following.name} differ by more than their numbers"
    if unsure:
        return "a number with a point may be a decimal, or two counters"
    return _misleading(paths, list(zip(*(_NUMBER.split(path.stem)[1::2] for path in paths), strict=True)))


def _keys(paths: list[Path]) -> tuple[dict[Path, Key], bool]:
    """By what each path is sorted, texts and numbers in turn, and whether it is unsure how to read a number."""
    pieces = {path: _NUMBER.split(path.stem) for path in paths}
    columns: dict[Column, set[tuple[str, str]]] = defaultdict(set)
    for names in pieces.values():
        for place in range(1, len(names), 2):
            columns[tuple(names[::2]), place].add(_halves(names[place]))
    read = {column: _counters(numbers) for column, numbers in columns.items()}
    keys: dict[Path, Key] = {}
    for path, names in pieces.items():
        key = keys[path] = list(names)
        for place in range(1, len(names), 2):
            whole, fraction = _halves(names[place])
            counters, _ = read[tuple(names[::2]), place]
            key[place] = (Decimal(whole), int(fraction or -1)) if counters else (Decimal(f"{whole}.{fraction or 0}"), 0)
    return keys, any(not sure for _, sure in read.values())


def _counters(numbers: set[tuple[str, str]]) -> tuple[bool, bool]:
    """Whether numbers (before and after a point) are two counters each rather than a decimal, and whether that is sure."""
    pairs = {(whole, fraction) for whole, fraction in numbers if fraction}
    as_decimals = sorted(pairs, key=lambda pair: (int(pair[0]), pair[1]))
    if as_decimals == sorted(pairs, key=lambda pair: (int(pair[0]), int(pair[1]))):
        return False, True
    counted = any(
        len(fraction) > 1 and fraction.endswith("0") or len((whole + fraction).lstrip("0")) > _DIGITS
        for whole, fraction in pairs
    )
    padded = any(len(fraction) > 1 and fraction.startswith("0") for _, fraction in pairs)
    # nanoseconds counted without zeros before them would end in zeros here and there, or have nine digits
    seconds = all(len(whole) == 10 and whole.startswith("1") for whole, _ in pairs)
    return counted, counted != padded or (seconds and not counted)


def _halves(number: str) -> tuple[str, str]:
    """The digits before and after what joins a number, none after where nothing does."""
    whole, *rest = re.split("[.,_-]", number)
    return whole, "".join(rest)


def _misleading(paths: list[Path], numbers: list[tuple[str, ...]]) -> str | None:
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
