"""Laws of the pages that show a study: their tables are what its file holds, to the last digit that is printed."""

import re

import pytest

from tools.page_tables import DOCS, TABLES, page_path, with_tables

pytestmark = pytest.mark.studies


def test_the_tables_of_every_page_equal_the_results_of_its_studies():
    texts = {page: page_path(page).read_text("utf-8") for page, *_ in TABLES}
    filled_anew = {page: with_tables(page, text).splitlines() for page, text in texts.items()}
    assert filled_anew == {page: text.splitlines() for page, text in texts.items()}


def test_a_differing_table_is_filled_anew():
    text = (DOCS / "evaluation-kitting.md").read_text("utf-8")
    other = re.sub(r"^(\| \w+ \|) \d+", r"\1 7", text, flags=re.MULTILINE)
    assert other != text and with_tables("evaluation-kitting", other) == text
