"""Laws of the pages that show a study: their tables and counts are what its file holds, to the last digit that is printed."""

import math
import re
from collections import Counter

import pytest

from tools.page_tables import DOCS, TABLES, filled, page_path, study, with_tables
from tools.studies.stability.command import _answers

pytestmark = pytest.mark.studies


def test_the_tables_of_every_page_equal_the_results_of_its_studies():
    texts = {page: page_path(page).read_text("utf-8") for page, *_ in TABLES}
    filled_anew = {page: with_tables(page, text).splitlines() for page, text in texts.items()}
    assert filled_anew == {page: text.splitlines() for page, text in texts.items()}


def test_a_differing_table_is_filled_anew():
    text = (DOCS / "kitting.md").read_text("utf-8")
    other = re.sub(r"^(\| \w+ \|) \d+", r"\1 7", text, flags=re.MULTILINE)
    assert other != text and with_tables("kitting", other) == text


def listed(values, form=".0f"):
    """Values as a sentence names them."""
    *most, last = (f"{value:{form}}" for value in values)
    return f"{', '.join(most)} and {last}"


def counted(some):
    """How many estimates are right, how many of these carry a warning, how many are wrong, how many of these are undetected."""
    warned = [each.warned for each in some if not each.wrong]
    return len(warned), sum(warned), len(some) - len(warned), sum(each.silent for each in some)


def endured(content):
    alike, beyond, jaw, extrinsics = Counter(), [], [], []
    for object_name, own in content["parts"].items():
        for name, sweep in own["sweeps"].items():
            for at in sweep["levels"]:
                found, well = _answers(at["answers"]), at["level"] in sweep["inside"]
                alike.update([(object_name, *found)] * well)
                beyond += found * (not well)
                jaw += found * (name == "jaw")
                extrinsics += found * (name.startswith("rig") and not well)
    same = max(alike.values())
    yield f"{({9: 'Nine', 10: 'Ten'}).get(same, same)} of these levels are the same touches"
    row = "of {} right ones {} carry a warning ({:.1%}), and of {:,} wrong ones {} are undetected"
    right, warned, *wrong = counted([each for _, *found in alike for each in found])
    yield filled(row, right, warned, warned / right, *wrong)
    yield "{2:,} estimates are wrong, and {3} of them are undetected".format(*counted(beyond))
    yield "of {} right ones {} carry a warning".format(*counted(jaw))
    yield "of {2} wrong estimates {3} are undetected".format(*counted(extrinsics))


def stated_together(content):
    at = {}
    for name, sweep in content["together"].items():
        for level in sweep["levels"]:
            key = int(level["level"]) if level["level"] == int(level["level"]) else str(level["level"])
            ninety, held = level["figures"]["coverage"][1], level["level"] in sweep["inside"]
            at.setdefault(name, {})[key] = level["figures"] | {"ninety": ninety, "held": held}
    held, beyond = ([f for sweep in at.values() for f in sweep.values() if f["held"] == well] for well in (True, False))
    within = [f["ninety"]["low"] <= 0.95 and f["ninety"]["high"] >= 0.85 for f in held]
    shares = [100 * f["ninety"]["share"] for f in held]
    assert all(within)
    yield f"at all {len(held)} levels; the share itself is {min(shares):.0f} to {max(shares):.0f} %"
    one_in = min(math.floor(f["wrong"] / f["silent"] + 1e-9) for f in beyond if f["silent"])
    yield f"at no level more than one in {({9: 'nine'}).get(one_in, one_in)}"
    for name, unit in {"rig_shift": " mm", "rig_turn": "°"}.items():
        warned = listed([100 * at[name][level]["warned"] for level in (1, 2, 5, 10)])
        yield f"{warned} %{' of the estimates' * (unit == ' mm')} at 1, 2, 5 and 10{unit}"
    silent = sum(f["n"] for level, f in at["slips"].items() if level and not f["warned"])
    yield f"none of {silent} sequences with slips carries a warning"
    yield from (filled(sentence, **at) for sentence in SENTENCES)


SENTENCES = [
    "From 16 to 2 mm² a touch gives {area[16][gain_mean]:.1f} to {area[2][gain_mean]:.1f} nats",
    "at 1 mm² {area[1][gain_mean]:.1f}, at 0.5 mm² {area[0.5][gain_mean]:.1f}, at 0.1 mm² nothing; it expects as little (",
    "({area[1][claimed_mean]:.1f}, {area[0.5][claimed_mean]:.1f} and {area[0.1][claimed_mean]:.1f}), and a third",
    "{size[5][gain_mean]:.1f} nats are gained where {size[5][claimed_mean]:.1f} are expected, and {size[5][ninety][share]:.0%}",
    "with pixels 10 % larger than stated {pitch[10][ninety][share]:.0%}. No warning comes",
    "of flat ones {kind[1][ninety][share]:.0%} of {kind[1][n]}, of cylinders {kind[4][ninety][share]:.0%} (",
    "of contacts of several patches {kind[5][ninety][share]:.0%} of {kind[5][n]} (",
    "({kind[5][claimed_mean]:.1f} nats expected for {kind[5][gain_mean]:.1f})",
    "show two patches {shown[2][ninety][share]:.0%} of the truths lie in the 90 % region, of those that show three or more",
    "three or more {shown[3][ninety][share]:.0%} ({shown[3][claimed_mean]:.1f} nats expected for {shown[3][gain_mean]:.1f})",
    "of one {shown[1][ninety][share]:.0%}",
    "({jaw[0][gain_mean]:.1f} nats gained, {jaw[0][claimed_mean]:.1f} expected)",
]
COUNTS = [
    ("stability", endured, "stability"),
    ("stability", stated_together, "stability"),
]


@pytest.mark.parametrize(("page", "says", "name"), COUNTS)
def test_the_prose_of_a_page_agrees_with_its_study(page, says, name):
    text = " ".join((DOCS / f"{page}.md").read_text("utf-8").split())
    assert [
        sentence for sentence in says(study(name)) if not re.search(rf"(?<![\d.,]){re.escape(sentence)}", text)
    ] == []
