"""The order of a folder's images by their names: time stamps by value, counters as they count, and a word where it is open."""

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
    """The stems of shuffled names in the order taken, and what is said of it."""
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
    ],
)
def test_counters_and_dates_sort_as_they_count(names):
    assert ordered(names) == (names, None)


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (["1699999999.25", "1699999999.5"], "a number with a point may be a decimal, or two counters"),
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
        f"the names do not settle the order of the images: {why}; taken is {', '.join(f'{name}.png' for name in names)}; "
        "to give another, write their paths to standard input, and - for the folder"
    )


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
