"""The order of images by their names: numbers in them by value; and what names leave open."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

from geomtact.cli.frame_times import misleading

# A number in a name: two joined by one point or comma are one, 1.25, but three are three, as in a date. Ten digits that begin
# with 1 are seconds since 1970: what follows them after _ or - is joined to them too.
_NUMBER = re.compile(
    r"((?<![0-9])1[0-9]{9}[_-][0-9]+|(?<![0-9])(?<![0-9][.,])[0-9]+[.,][0-9]+(?![0-9])(?![.,][0-9])|[0-9]+)"
)
_DIGITS = 17  # that Python writes a float with at most, zeros before them aside
_SHOWN = 3  # names of the order taken that a warning gives

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
    return misleading(paths, list(zip(*(_NUMBER.split(path.stem)[1::2] for path in paths), strict=True)))


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
