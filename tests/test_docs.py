"""Laws of the pages: every link leads somewhere, and every command that they show is one that geomtact or a checkout has."""

import re
import shlex
from pathlib import Path

import pytest
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if re.match(r"[a-z]+:", target):  # to other sites
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(there), f"{page.name}: {target}"


def shown(page: Path) -> list[list[str]]:
    """The commands of ``PROGRAMS`` that a page shows, in words, each up to a pipe or a comment."""
    text = re.sub(r"\\\n\s*", " ", page.read_text("utf-8"))
    lines = re.findall(r"^(?:    |\$ )?(?:python -m )?((?:geomtact|tools\.\w+) [^\n]*)$", text, re.MULTILINE)
    return [shlex.split(re.split(r"\s[|>&]|\s\d>", line)[0], comments=True) for line in lines]


@pytest.mark.parametrize("page", [page for page in PAGES if shown(page)], ids=lambda page: page.name)
def test_every_command_shown_is_there_with_its_options(page):
    for words in shown(page):
        command, words = COMMANDS[words[0]], words[1:]
        while hasattr(command, "commands"):
            known = command.commands
            assert words and (words[0] in known or words[0].startswith("-")), f"{page.name}: {words}"
            if words[0].startswith("-"):
                break
            command, words = known[words[0]], words[1:]
        options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
        for word in words:
            name = word.partition("=")[0]
            assert not re.match(r"--?[a-z]", name) or name in {*options, "--help"}, f"{page.name}: {words}"


def test_there_are_commands_to_check():
    assert sum(len(shown(page)) for page in PAGES) > 40
