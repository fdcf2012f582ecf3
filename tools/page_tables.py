"""Fills the tables of the documentation from the files of the studies, in place:

    python -m tools.page_tables

A cell that no file holds, as a name in words, stays what it is, and what is bold stays bold.
"""

import csv
import json
import re
from functools import cache
from pathlib import Path

from tools import page_rows
from tools.page_rows import KEPT

DOCS = Path(__file__).parents[1] / "docs"


TABLES = [
    ("README", "| images |", page_rows.expected, "touches", "triplets"),
    ("evaluation-real-images", "| set |", page_rows.contacts, "readings"),
    ("evaluation-real-images", "| camera |", page_rows.balls, "readings"),
    ("no-more-than-needed", "| choice |", page_rows.ablations, "choices"),
    ("speed-accuracy", "| variant |", page_rows.variants, "choices"),
    ("speed-accuracy", "| gain [nats] /", page_rows.known_face, "choices"),
    ("evaluation-several-sensors", "| object |", page_rows.touches, "touches"),
    ("evaluation-several-sensors", "| shown |", page_rows.elsewhere_simulated, "triplets"),
    ("evaluation-tracking", "| method |", page_rows.followed, "track"),
    ("evaluation-next-touch", "| object |", page_rows.until_sure, "next_touch"),
    ("evaluation-kitting", "| object |", page_rows.placed, "kitting"),
    ("evaluation-identification", "| touches |", page_rows.identified, "identification"),
    ("evaluation-registration", "| method | success", page_rows.from_everywhere, "registration"),
    ("evaluation-registration", "| method | error", page_rows.from_grid, "registration"),
    ("evaluation-registration", "| contact |", page_rows.by_contact, "registration"),
    ("benchmark", "| what |", page_rows.cost, "benchmark"),
    ("benchmark", "| kernel", page_rows.kernels, "benchmark"),
    ("benchmark", "| score | threads", page_rows.retrieval, "peers"),
    ("benchmark", "| pixels |", page_rows.simulation, "peers"),
    ("benchmark", "| score | pin", page_rows.scores, "scores"),
    ("benchmark", "| contact |", page_rows.kinds, "classes", "flat"),
    ("benchmark", "| object |", page_rows.answers, "localize"),
    ("robustness", "| sweep |", page_rows.sweeps, "stability"),
]


@cache
def study(name):
    """What the file of a study holds."""
    return json.loads((DOCS / "results" / f"{name}.json").read_text("utf-8"))


def with_table(text, above, rows):
    """A page's text with ``rows`` in the first table at or below the words ``above``."""
    start = text.rindex("\n", 0, text.index(above)) + 1
    found = re.compile(r"(?:^ *\|.*\n)+", re.MULTILINE).search(text, start)
    heading, rule, *old = found[0].splitlines()
    new = list(rows)
    if len(new) != len(old) and any(KEPT in row for row in new):
        raise SystemExit(
            f"{above}: {len(new)} rows found, {len(old)} on the page; write those that begin with words by hand"
        )
    old = [*old, *[""] * len(new)][: len(new)]
    indent = heading[: heading.index("|")]
    lines = [heading, rule, *(_line(indent, *pair) for pair in zip(old, new, strict=True))]
    return text[: found.start()] + "\n".join(lines) + "\n" + text[found.end() :]


def _line(indent, old, row):
    before = [cell.strip() for cell in old.strip()[1:-1].split("|")]
    before += [""] * (len(row) - len(before))
    told = (was if cell is KEPT else _like(was, cell) for was, cell in zip(before, row, strict=True))
    return f"{indent}| {' | '.join(told)} |"


def _like(was, cell):
    """A cell in bold where it was, and where there is anything in it."""
    return f"**{cell}**" if was.startswith("**") and cell else cell


def with_tables(page, text):
    """The text of a page, its tables as the studies have it."""
    for name, above, table, *studies in TABLES:
        if name == page:
            text = with_table(text, above, table(*map(study, studies)))
    return text


def page_path(page):
    """The file of a page: the README lies above the others."""
    return (DOCS.parent if page == "README" else DOCS) / f"{page}.md"


def write_meshes_csv():
    """``results/meshes.csv``: what tools/prep_mesh.py made of each file of meshes.json, a row each."""
    symmetries = {"none": "none", "axis": "any turn", "sphere": "any rotation"}
    with (DOCS / "results" / "meshes.csv").open("w", newline="", encoding="utf-8") as file:
        write = csv.writer(file, lineterminator="\n").writerow
        write(["file", "unit", "outcome", "deviation_mm", "seconds", "symmetry", "changes", "warnings", "reason"])
        for mesh in study("meshes")["meshes"]:
            found = mesh.get("symmetry", {"kind": ""})
            symmetry = symmetries.get(found["kind"], f"{found.get('order', '')}-fold" * bool(found["kind"]))
            symmetry += " and flip" * (found["kind"] == "axis" and found["order"] == 2)
            changes = "; ".join(f"{step}: {words}" for step, words in mesh.get("changes", {}).items())
            off = f"{mesh['deviation_mm']:.4f}" if "deviation_mm" in mesh else ""
            row = [mesh["file"], mesh.get("unit"), mesh["outcome"], off, mesh["seconds"], symmetry, changes]
            write([*row, "; ".join(mesh.get("warnings", [])), mesh["reason"]])


def main():
    write_meshes_csv()
    for page in dict.fromkeys(name for name, *_ in TABLES):
        path = page_path(page)
        before = path.read_text("utf-8")
        after = with_tables(page, before)
        if after != before:
            path.write_text(after, "utf-8")
        print(f"{path.relative_to(DOCS.parent)}: {'as it was' if after == before else 'filled'}")


if __name__ == "__main__":
    main()
