"""Laws of the pages: every link leads somewhere, and every command that they show is one that geomtact or a checkout has."""

import re
import shlex
from pathlib import Path

import typer

from geomtact.cli import app
from tools.studies.__main__ import app as studies
from tools.training.__main__ import app as training

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = {"geomtact": app, "tools.studies": studies, "tools.training": training}
COMMANDS = {name: typer.main.get_command(program) for name, program in PROGRAMS.items()}


def anchors(page: Path) -> set[str]:
    """The names by which a page's headings are linked to."""
    headings = re.findall(r"^#+ +(.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def test_every_link_leads_somewhere():
    lost = []
    for page in PAGES:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
            if re.match(r"[a-z]+:", target):  # to other sites
                continue
            path, _, anchor = target.partition("#")
            there = (page.parent / path).resolve() if path else page
            if not there.exists() or (anchor and anchor not in anchors(there)):
                lost.append(f"{page.name}: {target}")
    assert not lost, "\n".join(lost)


def shown(page: Path) -> list[list[str]]:
    """The commands of ``PROGRAMS`` that a page shows, in words, each up to a pipe or a comment."""
    text = re.sub(r"\\\n\s*", " ", page.read_text("utf-8"))
    lines = re.findall(r"^(?:    |\$ )?(?:python -m )?((?:geomtact|tools\.\w+) [^\n]*)$", text, re.MULTILINE)
    return [shlex.split(re.split(r"\s[|>&]|\s\d>", line)[0], comments=True) for line in lines]


def unknown_words(words: list[str]) -> list[str]:
    """Those words of a command that name a command or an option which geomtact has not."""
    command, words = COMMANDS[words[0]], words[1:]
    while hasattr(command, "commands"):
        known = command.commands
        if not words or not (words[0] in known or words[0].startswith("-")):
            return words[:1] or ["no command"]
        if words[0].startswith("-"):
            break
        command, words = known[words[0]], words[1:]
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    names = [word.partition("=")[0] for word in words]
    return [name for name in names if re.match(r"--?[a-z]", name) and name not in {*options, "--help"}]


def test_every_command_shown_is_there_with_its_options():
    commands = [(page, words) for page in PAGES for words in shown(page)]
    assert len(commands) > 40
    wrong = [f"{page.name}: {' '.join(words)}: {found}" for page, words in commands if (found := unknown_words(words))]
    assert not wrong, "\n".join(wrong)
