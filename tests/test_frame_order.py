"""The order of a folder's images by their names: time stamps by value, counters as they count, and a word where it is open."""

import os
import random
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from geomtact.cli.frame_order import doubt, in_order
from geomtact.cli.frames import all_frames
from geomtact.sensing.image_file import write_image

TIMES = [1.7e9 + i / 30 + 1e-3 * (i * 0.618 % 1) for i in range(300)]


def ordered(stems):
    """The stems of shuffled names in the order taken, and the note on it."""
    stems = list(stems)
    random.Random(0).shuffle(stems)
    paths = in_order(Path(f"{stem}.png") for stem in stems)
    return [path.stem for path in paths], doubt(paths)


WRITTEN = {
    "str(time.time())": str,
    "with a prefix": lambda t: f"frame_{t}",
    "_ for the point": lambda t: f"left_{t}".replace(".", "_"),
    "three decimals at most": lambda t: str(round(t, 3)),
    "since the start": lambda t: str(t - 1.7e9 + 0.5),
    "padded": lambda t: f"{t:.6f}",
    "nanoseconds": lambda t: f"{Decimal(t) * 10**9:.0f}",
    "seconds and nanoseconds, not padded": lambda t: f"{int(t)}.{int(Decimal(t) % 1 * 10**9)}",
    "seconds and microseconds, not padded": lambda t: f"{int(t)}_{int(Decimal(t) % 1 * 10**6)}",
}


@pytest.mark.parametrize("how", WRITTEN)
def test_time_stamps_sort_by_value(how):
    names = [WRITTEN[how](t) for t in TIMES]
    assert len(set(names)) == 300
    assert ordered(names) == (names, None)


@pytest.mark.parametrize(
    "names",
    [
        ["2", "10", "100"],
        ["frame_9", "frame_10", "frame_11"],
        ["0001", "0002", "0010"],
        ["touch-1.1", "touch-1.9", "touch-1.10", "touch-2.1"],
        ["touch-1_2", "touch-1_9", "touch-1_12"],
        ["2026.9.30", "2026.11.2", "2027.1.1"],
        ["2026-11-27T10-00-00", "2026-11-27T10-00-00.033412", "2026-11-27T10-00-01"],
        ["0.0", "0.5", "12.25"],
        ["1699999999.25", "1699999999.5", "1699999999.75", "1700000000.0"],
    ],
)
def test_counters_and_dates_sort_as_they_count(names):
    assert ordered(names) == (names, None)


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (["touch-1.11", "touch-1.9"], "a number with a point may be a decimal, or two counters"),
        (["1.05", "1.9", "1.10"], "a number with a point may be a decimal, or two counters"),
        (["01", "1"], "01.png and 1.png have the same number"),
        (["left_1", "left_2", "right_1"], "left_2.png and right_1.png differ by more than their numbers"),
        (["1", "2", "background"], "2.png and background.png differ by more than their numbers"),
    ],
)
def test_names_that_leave_the_order_open_bring_a_warning(names, why):
    taken, said = ordered(names)
    assert taken == names
    assert said == (
        f"the names do not settle the order of the images: {why}; the order used is "
        f"{', '.join(f'{name}.png' for name in names)}; for another, give - as the source and write the paths to standard input"
    )


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (["0p041", "0p57", "0p073"], "041 and 57 may be the digits after a point"),
        (["1_042", "1_308", "1_0755"], "0755 and 042 may be the digits after a point"),
        (["01-02-2024_00-00-00", "31-01-2024_23-59-59"], "dates with the year last, 01-02-2024 and 31-01-2024, do not sort"),
        (["01.01.2024", "12.31.2023"], "dates with the year last, 01.01.2024 and 12.31.2023, do not sort"),
        (["00-00-00", "00-00-01", "23-59-58", "23-59-59"], "23 may come before 00, where a counter or a clock starts anew"),
        (["img_0000", "img_0001", "img_9998", "img_9999"], "9999 may come before 0000, where a counter or a clock starts"),
        (["17000000005", "1700000000123456789"], "1700000000123456789 and 17000000005 may be seconds and what follows"),
        (["cam0_1", "cam0_2", "cam0_3", "cam1_1", "cam1_2", "cam1_3"], "the numbers after 0 and after 1 run alike"),
    ],
)  # fmt: skip
def test_numbers_that_do_not_sort_by_time_bring_a_warning(names, why):
    taken, said = ordered(names)
    assert taken == names and f"the names do not settle the order of the images: {why}" in said and "\n" not in said


def test_a_comma_is_a_point():
    names = ["0,041", "0,073", "0,57", "1,2"]
    assert ordered(names) == (names, None)


@pytest.mark.parametrize(
    "names",
    [
        [f"img_{k:04}" for k in range(0, 10000, 9)],
        [f"{k:03}" for k in range(1000)],
        [f"10-{m:02}-{s:02}" for m in range(3) for s in range(0, 60, 5)],
        [f"{h:02}-{m:02}-00" for h in range(24) for m in (0, 59)],
        ["2024-01-31_23-59-59", "2024-02-01_00-00-00"],
        [f"touch{k}_{frame}" for k in range(20) for frame in range(5)],
        [f"cam0_{k}" for k in range(20)],
        ["27-11-2026_10-00-00", "27-11-2026_10-00-01"],
        [str(10**11 + k * 10**10) for k in range(100)],
        ["touch-1_0", "touch-1_9", "touch-1_10"],
    ],
)
def test_numbers_that_sort_bring_none(names):
    assert ordered(names) == (names, None)


def warned(folder, names, times):
    """The notes on files written in a folder at times [s]."""
    for name, at in zip(names, times, strict=True):
        (folder / name).touch()
        os.utime(folder / name, (at, 1.7e9 + at))
    return doubt(in_order(folder.iterdir()))


NAMES = [f"{k}.png" for k in range(8, 16)]


@pytest.mark.parametrize("step", [1 / 5, 1, 60])
def test_files_written_in_another_order_bring_a_warning(tmp_path, rng, step):
    times = np.roll(np.arange(8), 3) * step * rng.uniform(0.99, 1.01)
    assert "images: 10.png was written after 11.png; the order used is 8.png, 9.png" in warned(tmp_path, NAMES, times)


@pytest.mark.parametrize(
    "times",
    [
        pytest.param(range(8), id="as named"),
        pytest.param([6, 7, 0, 1, 2, 3, 4, 5], id="as texts sort, by a copy or git"),
        pytest.param([0] * 8, id="at once"),
        pytest.param([0, 0, 0, 5, 0, 0, 3, 0], id="unpacked, two later"),
        pytest.param(np.array([5, 1, 4, 2, 3, 0, 7, 6]) / 100, id="in any order, quickly"),
        pytest.param([2.9, 0.3, 2.31, 0.31, 1.2, 0.9, 1.19, 2.1], id="in any order, within seconds"),
    ],
)
def test_copied_files_bring_none(tmp_path, times):
    assert warned(tmp_path, NAMES, times) is None


def test_a_folder_is_given_in_order_with_the_doubt_on_standard_error(tmp_path, capsys):
    names = [f"{t}.png" for t in TIMES[:12]]
    for name in reversed(names):
        write_image(tmp_path / name, np.zeros((8, 8), bool))
    assert [Path(frame.image).name for frame in all_frames(str(tmp_path))] == names
    assert capsys.readouterr().err == ""
    (tmp_path / "background.png").write_bytes((tmp_path / names[0]).read_bytes())
    assert len(list(all_frames(str(tmp_path)))) == 13
    (warning,) = capsys.readouterr().err.splitlines()
    assert warning.startswith(f"warning: {tmp_path}: the names do not settle the order of the images")
