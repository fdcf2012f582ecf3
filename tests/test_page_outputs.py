"""What the pages print of their commands is what a run gives on any processor, within the tolerances of tools/page_outputs.py."""

import pytest

from tools.page_outputs import PAGES, agree, refreshed, replaced, run, shown_on

SAID = """
mode probability centre
1 2.2 % -7.74, 11.00
2 2.1 % 28.15, 46.92

8,389 of 1,237,368 poses, in 12.3 s
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where commands run, with a separate cache, so at the full size."""
    folder = tmp_path_factory.mktemp("pages")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GEOMTACT_CACHE", str(folder / "cache"))
        yield folder


# what the gallery prints takes minutes and rests on chosen touches; tests/test_examples.py holds what it is there to show
COMPARED = PAGES[:2]


@pytest.mark.slow
@pytest.mark.parametrize("page", COMPARED, ids=lambda page: page.name)
def test_a_page_prints_the_output_of_its_commands(page, folder):
    for shown in shown_on(page):
        given = run(shown.words, folder)
        assert agree(shown.output, given), f"{page.name}: {shown.words}; run python -m tools.page_outputs\n{given}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_there_are_outputs_to_compare(page):
    assert sum(bool(shown.output) for shown in shown_on(page)) >= 2


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("12.3 s", "9 s", True),
        ("8,389", "8,400", True),
        ("8,389", "9,389", False),
        ("-7.74", "-7.79", True),
        ("-7.74", "7.74", False),
        ("1 2.2 % -7.74, 11.00\n2 2.1 % 28.15, 46.92", "1 2.2 % 28.15, 46.92\n2 2.1 % -7.74, 11.00", True),
        ("centre", "middle", False),
        ("\n\n8,389", "\n8,389 of it\n\n8,389", False),
    ],
)
def test_outputs_agree_but_for_the_last_digits_and_times(old, new, same):
    assert agree(SAID, SAID.replace(old, new)) is same


def test_an_ellipsis_matches_any_lines():
    assert agree("...\n8,389 of 1,237,368 poses, in 1 s", SAID)
    assert not agree("...\n8,389 of 9 poses, in 1 s", SAID)


def test_a_page_is_filled_with_the_output_of_its_commands():
    console = "```console\n$ geomtact x 'a b'\nold 1\n...\nmore 2\n$ geomtact y\n```\n"
    script = "```python\nprint(1)\n```\n\nText.\n\n```python\nprint(2)\n```\n\n```\nold\n```\n"
    given = {
        ("geomtact", "x", "a b"): "new\nold 7\nand\nso on\nmore 8\nend",
        ("geomtact", "y"): "1",
        ("python", "-c", "print(2)\n"): "2",
    }
    filled = replaced(f"One:\n\n{console}\n{script}", lambda shown: refreshed(shown, given[shown.words]))
    console = "```console\n$ geomtact x 'a b'\nold 7\n...\nmore 8\n$ geomtact y\n1\n```\n"
    assert filled == f"One:\n\n{console}\n{script.replace('old', '2')}"
