"""Laws of the pages that show a study: their tables and counts are what its file holds, to the last digit that is printed."""

import json
import math
import re
from collections import Counter
from functools import cache, partial
from pathlib import Path
from unittest.mock import ANY

import pytest

from geomtact.cli.evaluate_stability import _answers
from geomtact.cli.study_file import inside
from geomtact.evaluation.shapes import SHAPES
from geomtact.report.track_plot import LABELS

DOCS = Path(__file__).parents[1] / "docs"
PARTS = {"pin": "pin", "damping_pin": "damping pin", "head": "head", "elbow_pipe": "elbow pipe"}


@cache
def study(name):
    """What the file of a study holds."""
    return json.loads((DOCS / "results" / f"{name}.json").read_text("utf-8"))


def shown(page, above):
    """The cells of the first table at or below the words ``above`` of a page, without what makes them bold."""
    text = (DOCS / f"{page}.md").read_text("utf-8")
    table = re.search(r"(?:^ *\|.*\n)+", text[text.index(above) :], re.MULTILINE)[0].replace("**", "")
    return [[cell.strip() for cell in line.strip()[1:-1].split("|")] for line in table.splitlines()[2:]]


def filled(text, *values, **fields):
    """A page's text with what a study found in the place of its figures."""
    return re.sub(" ?%", " %", text.format(*values, **fields))


def cells(row, *values, **fields):
    """Those of a row, :func:`filled`."""
    return [cell.strip() for cell in filled(row, *values, **fields).split("|")]


def cut(x, decimals=1, whole=10):
    """A number with ``decimals``, from ``whole`` on with none."""
    return f"{x:.{decimals if x < whole else 0}f}"


def between(three, form=".2f"):
    """A value and its interval."""
    return "{:{form}} ({:{form}} to {:{form}})".format(*three, form=form)


def regions(f):
    """Percentages of truths inside the region of each mass."""
    return " / ".join(f"{100 * c['share']:.0f}" for c in f["coverage"])


def contacts(content):
    row = "{} | {} | {} | {iou_median:.3f} ({iou_interval[0]:.3f} to {iou_interval[1]:.3f}) | {iou_least:.2f} | "
    for key, name in {"fots": "FOTS", "objectfolder": "ObjectFolder", "gelslam": "GelSight Mini"}.items():
        for way, f in content["parts"][key]["figures"].items():
            factors = ", ".join(f"{factor:.2f}" for factor in f["factors"])
            first = f"{name} ({f['n']})" * (way == "auto")
            told = "auto, the default" if way == "auto" else way
            yield cells(row + "{centre_median:.3f}", first, told, factors, **f)


def balls(content):
    row = "{} | {ball_mm:.3f} mm | {n} | {right:.0%} | {} | {whole} | {off_mm_median:.2f} mm | {:.0%} | "
    for key, camera in {"parallel rays": "parallel rays", "camera at 20 mm": "at 20 mm"}.items():
        for k, f in enumerate(content["parts"][f"balls, {key}"]["figures"]):
            told = between(f["nats"], ".1f"), f["within_0.3_mm"]
            yield cells(row + "{off_mm_largest:.2f} mm", camera * (k == 0), *told, **f)


def modelled(part, content):
    one, three, side = (scene["modelled"] for scene in content["parts"][part]["scenes"].values())
    for name in one | side:
        both = one.get(name), (three | side).get(name)
        adds = [f and ("0.00" if not any(f["adds"]) else between(f["adds"], "+.2f")) for f in both]
        times = [f and f"x {cut(f['time_ratio'])}" for f in both]
        yield [name, *(told or "" for told in (adds[0], times[0], adds[1], times[1]))]


def ways(part, content):
    part, gain = content["parts"][part], "{gain_mean:.2f} ± {gain_standard_error:.2f}"
    for way, f in part["scenes"]["one touch"]["figures"].items():
        about, three = part["ways"][way], part["scenes"]["three sensors"]["figures"].get(way)
        if about["choice"] == "calibration" or way == "encoder":  # the default by another name
            continue
        name = {"grid": f"{about['poses']:,} poses", "score": f"`{way}`"}.get(about["choice"], ANY)
        one = cells(gain + " | {}", cut(f["ms_quantiles"][1]), **f)
        more = three and cells(gain + " | {mssd_mm_median:.1f} | {}", cut(three["ms_quantiles"][1]), **three)
        ready = "" if about["prepare_s"] is None else f"{about['prepare_s']:.0f}"
        yield [ANY if way == "the thesis's network" else name, *one, *(more or ["", "", ""]), ready]


def sides(content):
    row = "{gain_mean:.2f} / {mssd_mm_median:.0f} / {ms_quantiles[1]:.0f}"
    for way in ("balanced", "within 30 degrees", "this side alone", "this side, exact"):
        scenes = [content["parts"][part]["scenes"]["known side"] for part in PARTS]
        yield [ANY, *(row.format(**scene["figures"][way]) for scene in scenes)]


def touches(content):
    row = "{} | {sensors} | {gain_mean:.1f} | {} | {claimed_mean:.1f} | {} % | {mssd_mm_median:.1f} mm | "
    row += "{add_s_mm_median:.1f} mm | {add10_mm_median:.1f} mm | {probability_median:.0%}"
    for name, part in content["parts"].items():
        for f in part["figures"]:
            yield cells(row, name, between(f["more"], "+.1f") if "more" in f else "", regions(f), **f)


def followed(content):
    more = "{more[0]:+.2f} ({more[1]:.2f} to {more[2]:.2f}) | {better:.0%}"
    held = {"filter": (more + " of {n}", "{lost} of {stretches}"), "frames": ("|", "")}
    for way, name in LABELS.items():
        compared, lost = held.get(way, (more, held["filter"][1]))
        row = f"{{}} | {{gain_mean:.2f}} | {compared} | {{claimed_mean:.2f}} | {{}} | {lost}"
        yield cells(row, name, regions(content["figures"][way]), **content["figures"] | content["figures"][way])


def until_sure(content):
    row = "{} ({best[n]}{}) | {best[touches_mean]:.1f} | {random[touches_mean]:.1f} | {} | {:.0f} / {random[sure]:.0%}"
    for name, part in content["parts"].items():
        f = part["figures"]
        told = name, " runs" * (name == "pin"), between(f["ratio"]), 100 * f["best"]["sure"]
        yield cells(row + " | {best[wrong]:.0%} / {random[wrong]:.0%}", *told, **f)


def placed(content):
    for name, part in content["parts"].items():
        at = {(f["clearance_mm"], f["touches"]): f for f in part["figures"]}
        told = {k: "{right} / {wrong} / {refused}".format(**f) for k, f in at.items()}
        everyone = [told[k] for k in ((1, 1), (1, 2), (1, 3), (1, 4), (2, 4), (4, 4))]
        yield [name, str(at[1, 1]["n"]), *everyone, str(at[0.25, 4]["n"]), told[0.25, 4], told[0.5, 4]]


def identified(content):
    row = "{touches} | {} | {claimed:.0%} | {log_probability_mean:.2f} | {sure_and_wrong:.0%} | {} | {}"
    for f in content["figures"]:
        said = ([100 * x for x in f[key]] for key in ("right", "foreign", "alarmed"))
        yield cells(row, *("{:.0f} % ({:.0f} to {:.0f})".format(*three) for three in said), **f)


def from_everywhere(content):
    for method, f in content["figures"]["methods"].items():
        drift, believes = f["drift_mm_median"], "always" if f["converged"] > 0.99 else "{converged:.0%}"
        rest = f"{cut(drift, 2 if drift < 1 else 1)} mm | {cut(f['ms_median'], 1, 100)} ms"
        believes, rest = ("", "0 |") if method == "none" else (believes, rest)
        yield [ANY, *cells(f"{{success:.0%}} | {believes} | {cut(f['error_mm_median'], 2)} mm | {rest}", **f)]


ERRORS = "{error_mm_median:.2f} mm | {of_start:.2f} | {worse:.0%}"
STATED = "{coverage[0.9]:.0%} | {agreement:.0%}"


def from_grid(content):
    for method, f in content["figures"]["from_grid"].items():
        if method not in ("none", "open3d point to plane", "probreg point to plane"):
            yield [ANY, *cells(f"{ERRORS} | {STATED if f['stated'] else '|'}", **f)]


def by_contact(content):
    held, drifts = content["figures"]["from_grid_by_contact"], content["figures"]["drift"]
    for kind in sorted(held, key=lambda kind: kind not in SHAPES):
        own, peer = (drifts[kind][method]["median_mm"] for method in ("filterreg", "small_gicp point to plane"))
        row = f"{{}} | {{n}} | {ERRORS} | {{stated}} | {STATED} | {{:.2f}} mm | {{}} mm"
        yield cells(row, kind, own, cut(peer), **held[kind]["filterreg"])


def cost(content):
    made, warm, start = content["prepare"], content["localize_warm"], content["start"]

    def took(f, form, unit="ms"):
        return between((f["median"], f["10 %"], f["90 %"]), form).replace(" (", f" {unit} (")

    stages = (warm["ms"][f"balanced, {stage}"]["median"] for stage in ("score", "posterior", "refine"))
    measured = [
        f"{content['rays']['per_second_1_threads'] / 1e6:.1f} M",
        f"{made['index_s']:.1f} s, {round(made['poses_per_second'], -3):,.0f} poses a second",
        f"{made['calibration_s']:.0f} s",
        f"{made['prepare_s']:.0f} s",
        f"{made['peak_bytes'] / 1e9:.2f} GB",
        f"{made['index_bytes_per_pose']:.0f} bytes a pose, and 64 of the network",
        took(warm["ms"]["fast"], ".1f"),
        took(warm["ms"]["balanced"], ".0f"),
        "{:.0f} / {:.0f} / {:.0f} ms".format(*stages),
        took(warm["ms"]["exact"], ".0f"),
        took(warm["ms"]["the thesis's query"], ".0f"),
        f"{warm['balanced_over_thesis_query']:.2f}",
        took(warm["ms"]["balanced, modes after it"], ".0f"),
        f"{start['import_geomtact_s']['median']:.2f} s",
        f"{start['help_s']['median']:.2f} s",
        took(start["localize_s"], ".1f", "s"),
        took(start["localize_with_report_s"], ".1f", "s"),
    ]
    return [[ANY, cell, ANY] for cell in measured]


def retrieval(content):
    columns = ("largest", "geomtact, all", "range_search", "by search", "geomtact, ten", "Flat.*ten", "fp16", "8 bit")
    for score, threads in ((score, threads) for score in ("encoder", "cosine", "l1") for threads in (1, 2)):
        timed = [row for row in content["retrieval"] if (row["score"], row["threads"]) == (score, threads)]
        told = []
        for column in columns:
            row = next((row for row in timed if re.search(column, row["method"])), None)
            rate = " ({gb_per_s:.1f})" if column not in ("by search", "geomtact, ten") else ""
            told.append(row and (cut(row["ms"]["median"], 1, 100) + rate).format(**row))
        yield [f"`{score}`", str(threads), *(cell or "" for cell in told)]


def simulation(content):
    for wide, threads in ((wide, threads) for wide in (427, 32) for threads in (1, 2)):
        some = [r for r in content["simulation"] if (r["pixels"][0], r["threads"]) == (wide, threads)]
        told = [f"{r['ms_per_image']['median']:.2f} ({r['rays_per_s'] / 1e6:.1f})" for r in some]
        yield ["{} x {}".format(*some[0]["pixels"]), str(threads), *told]


def scores(content):
    gain, parts = "{gain_mean:.2f} ± {gain_standard_error:.2f}", ("pin", "damping_pin", "elbow_pipe", "head")
    mean = {name: entry["figures"]["all"] for name, entry in content["overall"].items()}
    for name in sorted(mean, key=lambda name: (-mean[name]["gain_mean"], name)):
        own = [gain.format(**content["parts"][part]["scores"][name]["figures"]["all"]) for part in parts]
        size = content["overall"][name]["bytes_per_pose"]
        yield [f"`{name}`", *own, *cells("{gain_mean:.2f} | {} | {:.0f}", regions(mean[name]), size, **mean[name])]


def kinds(content, flat):
    for kind, f in (content["classes"]["balanced"] | flat["classes"]["balanced"]).items():
        yield [*cells("{} | {n} | {gain_mean:.2f}", kind, **f), *inside(f)]


def answers(content):
    row = "{} | {}, {n} | {gain_mean:.2f} ± {gain_standard_error:.2f} | {claimed_mean:.2f}"
    for name, part in content["parts"].items():
        for felt in ("geometric", "elastic", "all"):
            yield [*cells(row, name, felt, **part["figures"][felt]), *inside(part["figures"][felt])]


def sweeps(content):
    for name, sweep in content["together"].items():
        levels, held = [at["level"] for at in sweep["levels"]], sweep["inside"]
        begin = f"{held[0]:g}" if held[0] != levels[0] else "down" if levels[0] > levels[-1] else "up"
        promised = "all" if held == levels else "0" if held == [0] else f"{begin} to {held[-1]:g}"
        told = f"{levels[0]:g} to {levels[-1]:g}" if name == "kind" else ", ".join(f"{level:g}" for level in levels)
        yield [f"`{name}`", ANY, told, promised]


TABLES = [
    ("readings", "| set |", contacts, "readings"),
    ("readings", "| camera |", balls, "readings"),
    *(("no-more-than-needed", f"The {PARTS[part]}:", partial(modelled, part), "choices") for part in PARTS),
    *(("speed-accuracy", f"The {PARTS[part]}:", partial(ways, part), "choices") for part in PARTS),
    ("speed-accuracy", "| gain [nats] /", sides, "choices"),
    ("several-sensors", "| part |", touches, "touches"),
    ("tracking", "| method |", followed, "track"),
    ("next-touch", "| part |", until_sure, "next_touch"),
    ("kitting", "| part |", placed, "kitting"),
    ("which-part", "| touches |", identified, "identification"),
    ("registration", "| method | success", from_everywhere, "registration"),
    ("registration", "| method | error", from_grid, "registration"),
    ("registration", "| contact |", by_contact, "registration"),
    ("benchmark", "| what |", cost, "benchmark"),
    ("benchmark", "| score | threads", retrieval, "peers"),
    ("benchmark", "| pixels |", simulation, "peers"),
    ("benchmark", "| score | pin", scores, "scores"),
    ("benchmark", "| contact |", kinds, "classes", "flat"),
    ("benchmark", "| part |", answers, "localize"),
    ("stability", "| sweep |", sweeps, "stability"),
    ("stability", "| part |", answers, "housing"),
]


@pytest.mark.parametrize(("page", "above", "table", "studies"), [(*some[:3], some[3:]) for some in TABLES])
def test_a_table_shows_what_its_study_found(page, above, table, studies):
    assert shown(page, above) == list(table(*map(study, studies)))


def listed(values, form=".0f"):
    """Values as a sentence names them."""
    *most, last = (f"{value:{form}}" for value in values)
    return f"{', '.join(most)} and {last}"


def of_a_known_side(content):
    scenes = [content["parts"][part]["scenes"]["known side"] for part in PARTS]
    ways = "this side alone", "this side, 1 mode", "balanced"
    five, one, unknown = (listed([s["figures"][way]["mssd_mm_median"] for s in scenes]) for way in ways)
    (more,) = zip(*(scene["modelled"].values() for scene in scenes), strict=True)
    times = sorted(f["time_ratio"] for f in more)
    yield f"they add {listed([between(f['adds']) for f in more], '')} on the pin, the damping pin, the head and the elbow"
    yield f"{five} mm off for {one} (largest distance"
    yield f"Such a touch takes {times[0]:.1f} to {times[-1]:.1f} times as long with them"
    yield f"{five} mm off for {unknown}. Gains"


def counted(some):
    """How many answers are right, how many of these carry a warning, how many are wrong, how many of these are silent."""
    warned = [each.warned for each in some if not each.wrong]
    return len(warned), sum(warned), len(some) - len(warned), sum(each.silent for each in some)


def endured(content):
    alike, beyond, jaw, rigs = Counter(), [], [], []
    for part, own in content["parts"].items():
        for name, sweep in own["sweeps"].items():
            for at in sweep["levels"]:
                told, well = _answers(at["answers"]), at["level"] in sweep["inside"]
                alike.update([(part, *told)] * well)
                beyond += told * (not well)
                jaw += told * (name == "jaw")
                rigs += told * (name.startswith("rig") and not well)
    same = max(alike.values())
    yield f"{({9: 'Nine', 10: 'Ten'}).get(same, same)} of these levels are the same touches"
    row = "of {} that are right {} carry a warning ({:.1%}), and of {:,} that are wrong {} say it neither"
    right, warned, *wrong = counted([each for _, *told in alike for each in told])
    yield filled(row, right, warned, warned / right, *wrong)
    yield "{2:,} answers are wrong, and {3} of them say so neither way".format(*counted(beyond))
    yield "of {} right ones {} carry a warning".format(*counted(jaw))
    yield "of {2} wrong answers {3} say nothing".format(*counted(rigs))


def told_together(content):
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
        yield f"{warned} %{' of the answers' * (unit == ' mm')} at 1, 2, 5 and 10{unit}"
    silent = sum(f["n"] for level, f in at["slips"].items() if level and not f["warned"])
    yield f"none of {silent} sequences with slips carries a warning"
    yield from (filled(sentence, **at) for sentence in SENTENCES)


SENTENCES = [
    "From 16 to 2 mm² a touch tells {area[16][gain_mean]:.1f} to {area[2][gain_mean]:.1f} nats",
    "at 1 mm² {area[1][gain_mean]:.1f}, at 0.5 mm² {area[0.5][gain_mean]:.1f}, at 0.1 mm² nothing; it claims as little (",
    "({area[1][claimed_mean]:.1f}, {area[0.5][claimed_mean]:.1f} and {area[0.1][claimed_mean]:.1f}), and a third",
    "{size[5][gain_mean]:.1f} nats are told where {size[5][claimed_mean]:.1f} are claimed, and {size[5][ninety][share]:.0%} of",
    "with pixels 10 % larger than said {pitch[10][ninety][share]:.0%}. No warning comes",
    "of flat ones {kind[1][ninety][share]:.0%} of {kind[1][n]}, of cylinders {kind[4][ninety][share]:.0%} (",
    "of contacts of several patches {kind[5][ninety][share]:.0%} of {kind[5][n]} (",
    "({kind[5][claimed_mean]:.1f} nats claimed for {kind[5][gain_mean]:.1f})",
    "show two patches {shown[2][ninety][share]:.0%} of the truths lie in the 90 % region, of those that show three or more",
    "three or more {shown[3][ninety][share]:.0%} ({shown[3][claimed_mean]:.1f} nats claimed for {shown[3][gain_mean]:.1f})",
    "of one {shown[1][ninety][share]:.0%}",
    "({jaw[0][gain_mean]:.1f} nats told, {jaw[0][claimed_mean]:.1f} claimed)",
]
COUNTS = [
    ("no-more-than-needed", of_a_known_side, "modes"),
    ("stability", endured, "stability"),
    ("stability", told_together, "stability"),
]


@pytest.mark.parametrize(("page", "says", "name"), COUNTS)
def test_a_page_says_in_words_what_its_study_holds(page, says, name):
    text = " ".join((DOCS / f"{page}.md").read_text("utf-8").split())
    assert [
        sentence for sentence in says(study(name)) if not re.search(rf"(?<![\d.,]){re.escape(sentence)}", text)
    ] == []
