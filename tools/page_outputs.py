"""Runs the commands that the pages show, and fills in what they print, in place:

    python -m tools.page_outputs [PAGE ...]

A block marked ``console`` holds commands after ``$`` and, below each, what it prints on standard output. A block of
Python that a block without a name follows directly is run, and the second one holds what it prints. A line ``...`` stands
for lines that are left out; the first and the last ones may be without it. Commands run in a scratch folder that shows the
checkout's ``meshes`` and ``docs``.
"""

import math
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "docs" / "quickstart.md", ROOT / "docs" / "gallery.md"]
CONSOLE = re.compile(r"(?<=^```console\n)((?:(?!```).*\n)*)", re.MULTILINE)
SCRIPT = re.compile(r"(^```python\n((?:(?!```).*\n)*)```\n\n?```\n)((?:(?!```).*\n)*)", re.MULTILINE)
# Processors with bfloat16 and without differ by 0.003 nats, 0.3 % of the poses and 0.01 % of probability on the sample.
ABSOLUTE, RELATIVE = 0.15, 0.02
NUMBER = re.compile(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?(?!\w)")
TIME = re.compile(r"\d[\d.,]* (?:ms|s|min)\b")  # is another one in every run
WIDTH = 120  # columns of the terminal
LEAST_ALIKE = 0.3  # a line that was reworded and the new one, as SequenceMatcher measures it


@dataclass(frozen=True)
class Shown:
    """A command or a piece of Python on a page, and the output that the page shows of it."""

    words: tuple[str, ...]
    output: str


def run(words: tuple[str, ...], folder: Path) -> str:
    """What a command prints, in a folder that holds links to ``meshes`` and ``docs``."""
    for name in ("meshes", "docs"):
        if not (folder / name).exists():
            (folder / name).symlink_to(ROOT / name)
    python = {"geomtact": [sys.executable, "-m", "geomtact"], "python": [sys.executable]}
    first = words[0].removeprefix(".venv/bin/")
    environment = os.environ | {"COLUMNS": str(WIDTH), "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(
        [*python.get(first, [first]), *words[1:]], cwd=folder, env=environment, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(f"{shlex.join(words)}: exit status {done.returncode}\n{done.stderr}")
    return "\n".join(line.rstrip() for line in done.stdout.strip("\n").splitlines())


def replaced(text: str, output: Callable[[Shown], str]) -> str:
    """A page's text with ``output`` of every command in the place of what it shows."""

    def console(block: re.Match) -> str:
        commands = re.split(r"^\$ ", block[1], flags=re.MULTILINE)[1:]
        parts = []
        for command in commands:
            line, _, shown = command.partition("\n")
            parts.append(f"$ {line}\n{_ended(output(Shown(tuple(shlex.split(line)), shown.strip(chr(10)))))}")
        return "".join(parts)

    def script(block: re.Match) -> str:
        return block[1] + _ended(output(Shown(("python", "-c", block[2]), block[3].strip("\n"))))

    return SCRIPT.sub(script, CONSOLE.sub(console, text))


def shown_on(page: Path) -> Iterator[Shown]:
    """The commands of a page."""
    found: list[Shown] = []
    replaced(page.read_text("utf-8"), lambda shown: found.append(shown) or shown.output)
    yield from found


def _ended(text: str) -> str:
    return f"{text}\n" if text else ""


def agree(printed: str, given: str) -> bool:
    """Whether a page's output is the one given: the same words, numbers within the tolerance, times of any length.

    Modes of nearly the same probability may change places, and so may the lines that begin with their numbers.
    """
    before, after = _lines(printed), _lines(given)
    if "..." in before:
        return all(any(_alike(line, other) for other in after) for line in before if line != "...")
    rows = [[line for line in lines if re.match(r"\d+ +[\d.]+ %", line)] for lines in (before, after)]
    rest = [[line for line in lines if line not in some] for lines, some in zip((before, after), rows, strict=True)]
    if any(len(ours) != len(theirs) for ours, theirs in (rows, rest)):
        return False
    free = [line.split(maxsplit=1)[1] for line in rows[1]]
    for line in rows[0]:
        found = next((other for other in free if _alike(line.split(maxsplit=1)[1], other)), None)
        if found is None:
            return False
        free.remove(found)
    return all(map(_alike, *rest))


def _lines(text: str) -> list[str]:
    """Lines with something in them, their times masked, spaces and rules as short as can be."""
    short = (re.sub(r"─+", "─", re.sub(r"\s+", " ", TIME.sub("(time)", line))).strip() for line in text.splitlines())
    return [line for line in short if line]


def _alike(one: str, other: str) -> bool:
    if NUMBER.sub("#", one) != NUMBER.sub("#", other):
        return False
    pairs = zip(*([float(n.replace(",", "")) for n in NUMBER.findall(line)] for line in (one, other)), strict=True)
    return all(math.isclose(a, b, rel_tol=RELATIVE, abs_tol=ABSOLUTE) for a, b in pairs)


def refreshed(shown: Shown, given: str) -> str:
    """The output to show: the given one, or where some lines are left out, those of it that are most like the shown ones."""
    if "..." not in shown.output.splitlines():
        return given
    lines, out, after = given.splitlines(), [], 0
    for line in _lines(shown.output):
        if line == "...":
            continue
        likeness = [SequenceMatcher(None, _bare(line), _bare(other)).ratio() for other in lines[after:]]
        if max(likeness, default=0.0) < LEAST_ALIKE:
            raise SystemExit(f"{shlex.join(shown.words)} prints nothing like {line!r}; change the page by hand")
        found = after + likeness.index(max(likeness))
        if out and any(line.strip() for line in lines[after:found]):
            out.append("...")
        out.append(lines[found])
        after = found + 1
    return "\n".join(out)


def _bare(line: str) -> str:
    return NUMBER.sub("#", _lines(line)[0]) if line.strip() else ""


def main() -> None:
    pages = [Path(name).resolve() for name in sys.argv[1:]] or PAGES
    with tempfile.TemporaryDirectory() as folder:
        for page in pages:
            before = page.read_text("utf-8")
            after = replaced(before, lambda shown: refreshed(shown, run(shown.words, Path(folder))))
            if after != before:
                page.write_text(after, "utf-8")
            print(f"{page.relative_to(ROOT)}: {'as it was' if after == before else 'filled'}")


if __name__ == "__main__":
    main()
