"""The rows of the documentation's tables, each from what the file of a study holds; ``tools.page_tables`` fills them in."""

import math
import re
from statistics import geometric_mean

from tools.studies.choices.plot import means
from tools.studies.common.study_file import inside
from tools.studies.registration.shapes import SHAPES
from tools.studies.track.plot import LABELS

KEPT = None  # a cell that stays what it is
PARTS = {"pin": "pin", "damping_pin": "damping pin", "head": "head", "elbow_pipe": "elbow pipe"}


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


VARIANTS = (
    "the grid alone",
    "fast",
    "balanced",
    "exact",
    "no mode refined",
    "75k poses",
    "1.2M poses",
    "the grid alone, cosine",
    "depth map",
)


def variants(content):
    figures = [
        (means(content, scene, "gain_mean"), means(content, scene, "mssd_mm_median"))
        for scene in ("one touch", "three sensors")
    ]
    for name in VARIANTS:
        row = [KEPT]
        for gains, errors in figures:
            row += (
                [f"{gains[name][1]:.1f}", cut(errors[name][1]), f"{gains[name][0]:.0f}"] if name in gains else [""] * 3
            )
        yield row


def known_face(content):
    row = "{gain_mean:.1f} / {mssd_mm_median:.0f} / {ms_quantiles[1]:.0f}"
    for name in ("balanced", "face to 30 degrees", "known face", "known face, exact"):
        scenes = [content["parts"][part]["scenes"]["known contact face"] for part in PARTS]
        yield [KEPT, *(row.format(**scene["figures"][name]) for scene in scenes)]


def ablations(content):
    parts = content["parts"].values()
    names = dict.fromkeys(name for part in parts for scene in part["scenes"].values() for name in scene["ablations"])
    for name in names:
        row = [name]
        for scenes in (("one touch", "known contact face"), ("three sensors",)):
            found = [part["scenes"][scene]["ablations"].get(name) for part in parts for scene in scenes]
            found = [f for f in found if f]
            if not found:
                row += ["", ""]
                continue
            mean = sum(f["gain"][0] for f in found) / len(found)
            half = math.hypot(*((f["gain"][2] - f["gain"][1]) / 2 for f in found)) / len(found)
            ratio = geometric_mean([f["time_ratio"] for f in found])
            row += [f"{mean:+.2f} ± {half:.2f}", f"x {ratio:.1f}"]
        yield row


def touches(content):
    row = "{} | {sensors} | {gain_mean:.1f} | {} | {claimed_mean:.1f} | {} % | {mssd_mm_median:.1f} mm | "
    row += "{add_s_mm_median:.1f} mm | {add10_mm_median:.1f} mm | {probability_median:.0%}"
    for name, part in content["parts"].items():
        for f in part["figures"]:
            yield cells(row, name, between(f["more"], "+.1f") if "more" in f else "", regions(f), **f)


def elsewhere_simulated(content):
    def spread(f, key, form=cut):
        low, middle, high = map(form, f[f"{key}_quartiles"])
        return f"{middle} ({low} to {high})"

    row = "{} | {touches} | {} | {} | {} | {compatible:.0%} | {touched:.0%} | {} | {} | "
    for f in content["figures"]:
        lengths = spread(f, "position_mm"), cut(f["position_mm_mean"]), spread(f, "add_s_mm")
        nats = spread(f, "gain"), spread(f, "claimed")
        means = "{gain_mean:.1f} / {claimed_mean:.1f} | {}"
        if not f["touches"]:
            nats, means = ("0", "0"), "0 / 0 |"
        shown = "tactile image" if f["shown"] == "reading" else f["shown"]
        yield cells(row + means, shown, *lengths, *nats, regions(f), **f)


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
        yield [KEPT, *cells(f"{{success:.0%}} | {believes} | {cut(f['error_mm_median'], 2)} mm | {rest}", **f)]


ERRORS = "{error_mm_median:.2f} mm | {of_start:.2f} | {worse:.0%}"
STATED = "{coverage[0.9]:.0%} | {agreement:.0%}"


def from_grid(content):
    for method, f in content["figures"]["from_grid"].items():
        if method not in ("none", "open3d point to plane", "probreg point to plane"):
            yield [KEPT, *cells(f"{ERRORS} | {STATED if f['stated'] else '|'}", **f)]


def by_contact(content):
    held, drifts = content["figures"]["from_grid_by_contact"], content["figures"]["drift"]
    for kind in sorted(held, key=lambda kind: kind not in SHAPES):
        own, peer = (drifts[kind][method]["median_mm"] for method in ("filterreg", "small_gicp point to plane"))
        row = f"{{}} | {{n}} | {ERRORS} | {{stated}} | {STATED} | {{:.2f}} mm | {{}} mm"
        yield cells(row, kind, own, cut(peer), **held[kind]["filterreg"])


def cost(content):
    made, warm, several, start = (content[k] for k in ("prepare", "localize_warm", "several", "start"))

    def took(f, form, unit="ms"):
        return between((f["median"], f["10 %"], f["90 %"]), form).replace(" (", f" {unit} (")

    stages = (warm["ms"][f"balanced, {stage}"]["median"] for stage in ("score", "posterior", "explore", "refine"))
    measured = [
        f"{made['index_s']:.1f} s",
        f"{made['calibration_s']:.1f} s",
        f"{made['prepare_s']:.1f} s",
        f"{made['peak_bytes'] / 1e9:.2f} GB",
        f"{made['index_bytes_per_pose']:.0f} bytes a pose",
        *(took(warm["ms"][effort], ".0f") for effort in ("fast", "balanced", "exact")),
        "{:.0f} / {:.0f} / {:.0f} / {:.0f} ms".format(*stages),
        *(
            ", ".join(took(several["ms"][f"{n} sensors, {effort}"], ".0f") for effort in ("fast", "balanced"))
            for n in (2, 3)
        ),
        took(warm["ms"]["the thesis's query"], ".0f"),
        f"{warm['balanced_over_thesis_query']:.2f}",
        took(warm["ms"]["balanced, modes after it"], ".0f"),
        f"{start['import_geomtact_s']['median']:.2f} s",
        f"{start['help_s']['median']:.2f} s",
        took(start["localize_s"], ".1f", "s"),
        took(start["localize_with_report_s"], ".1f", "s"),
    ]
    return [[KEPT, cell, KEPT] for cell in measured]


def kernels(content):
    cast = content["rays"]["per_second_2_threads"]
    yield [KEPT, f"{cast / 1e6:.1f} M", KEPT, KEPT]
    for one in content["kernels"].values():
        rate = one["per_second"] / 1e6
        yield [
            KEPT,
            f"{rate:.2f} M" if rate < 10 else f"{rate:.0f} M",
            KEPT,
            f"{100 * one['per_second'] / one['limit']:.0f} %",
        ]


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
        yield [f"`{name}`", KEPT, told, promised]


def expected(touches, triplets):
    def over(sensors, key, form="{:.1f}", scale=1.0):
        values = [
            scale * f[key] for part in touches["parts"].values() for f in part["figures"] if f["sensors"] == sensors
        ]
        low, high = (form.format(extreme(values)) for extreme in (min, max))
        return low if low == high else f"{low} to {high}"

    for number in (1, 2, 3, 5):
        first = f"simulated masks, {len(touches['parts'])} objects" * (number == 1)
        lengths = (over(number, f"{key}_mm_median") for key in ("add_s", "mssd"))
        yield [first, str(number), over(number, "gain_mean"), *lengths, over(number, "ms_median", scale=1e-3)]
    (f,) = (f for f in triplets["figures"] if (f["shown"], f["touches"]) == ("reading", 3))
    first = f"another simulator's images, {len(triplets['parts'])} objects"
    length, ms = f["add_s_mm_quartiles"][1], f["ms_quartiles"][1]
    yield [first, "3", f"{f['gain_mean']:.1f}", f"{length:.1f}", "", f"{1e-3 * ms:.1f}"]
